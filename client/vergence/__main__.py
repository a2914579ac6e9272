"""Entry point of ``python -m vergence``, the same command as ``vergence``."""

from vergence.cli.__main__ import main

if __name__ == "__main__":
    main()
