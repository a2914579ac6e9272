"""The error of a command, shown as one line instead of a traceback."""


class CliError(Exception):
    """A problem that the user can solve: one line on stderr, and the exit code."""

    def __init__(self, message: str, *, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code: int = exit_code
