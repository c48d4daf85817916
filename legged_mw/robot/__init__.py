"""A robot's health page: what it weighs, what its servos bear, how it stands, and a task to begin with."""
