"""The learner: rsl-rl with class configs. Only this package imports rsl_rl's algorithms and runners."""
