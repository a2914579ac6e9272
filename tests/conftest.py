"""The suite runs without torch and Mitsuba: what needs an extra is collected where it is."""

import gc
from importlib.util import find_spec

from hypothesis import settings

# Wall-clock deadlines judge the machine, not the code. CI looks deeper.
settings.register_profile("quick", deadline=None, max_examples=20)
settings.register_profile("deep", deadline=None, max_examples=60)
settings.load_profile("quick")

collect_ignore = [] if find_spec("torch") else ["models"]
collect_ignore_glob = [] if find_spec("mitsuba") else ["models/test_xrbench_*.py"]


def pytest_report_header() -> list[str]:
    needed = (("tests/models", "torch", "train"), ("models/test_xrbench_*.py", "mitsuba", "bench"))
    return [
        f'{left_out} is left out: it needs pip install -e ".[{extra}]"'
        for left_out, module, extra in needed
        if not find_spec(module)
    ]


def pytest_collection_finish() -> None:
    """What collection made stays until the end: the garbage collector need not look at it again."""
    gc.freeze()
