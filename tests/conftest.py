"""The suite runs without torch; what trains networks is collected where the train extra is."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("torch") else ["models"]


def pytest_report_header() -> str | None:
    if find_spec("torch"):
        return None
    return 'tests/models is left out: it needs pip install -e ".[train]"'
