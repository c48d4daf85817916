"""The learner: rsl-rl, fed from class configs. The only package that imports rsl_rl's algorithms and runners."""
