"""A robot's health page: mass, servo stability, standing test; and a first task for a new robot."""
