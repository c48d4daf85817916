"""Check a task before a training: whether its step can be recorded; and describe it."""
