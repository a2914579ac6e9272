"""Entry point of the ``vergence`` command; it reports a missing extra in one line."""

import sys

_NEEDED = {"httpx", "rich", "typer"}


def main() -> None:
    """Entry point of the console script."""
    try:
        from vergence.cli.app import run_program
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in _NEEDED:
            raise
        sys.exit(
            f"The vergence command needs {error.name}, which the thin client leaves out. "
            "Install it with: pip install 'vergence[cli]'"
        )
    run_program()


if __name__ == "__main__":
    main()
