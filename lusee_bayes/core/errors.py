"""What goes wrong in ways that a user can understand: one sentence, no traceback."""


class InputError(ValueError):
    """Input that cannot be used. The message says what is wrong, where, and what to do."""


class ProcessLost(RuntimeError):
    """Raised when another process of the run has ended, so that this one cannot go on."""
