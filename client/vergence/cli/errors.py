"""What a command says instead of a traceback."""


class Trouble(Exception):
    """Something the user can put right: one line on stderr, and the exit code."""

    def __init__(self, message: str, *, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code
