"""Programs around training: what this machine can do, many runs beside each other, kernels ahead of time, the shell's Tab key."""
