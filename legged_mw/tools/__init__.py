"""Programs around training: check the machine, sweep and compare runs, compile kernels, complete shell commands."""
