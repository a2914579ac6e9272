"""Entry point of the ``vergence`` command; it reports a missing extra in one line."""

import sys

from vergence_proto.extras import how_to_install

_NEEDED = {"httpx", "rich", "typer"}


def main() -> None:
    """Entry point of the console script."""
    try:
        from vergence.cli.app import run_program

        run_program()
    except ModuleNotFoundError as error:  # a command imports what it needs when it is called
        if error.name is None or error.name.partition(".")[0] not in _NEEDED:
            raise
        sys.exit(
            f"The vergence command needs {error.name}, which the thin client leaves out. "
            f"Install it with: {how_to_install('cli')}"
        )


if __name__ == "__main__":
    main()
