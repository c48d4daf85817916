"""The errors that are the user's to mend: one class, so that a program can print them as one line and exit."""


class UserError(Exception):
    """A mistake in what was asked, or something that the machine lacks; the text says what exists and what to do."""
