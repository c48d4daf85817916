"""Looks at a task before it is trained: whether its step can be recorded, and what it is made of."""
