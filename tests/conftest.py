"""The suite runs without torch and Mitsuba: what needs an extra is collected where it is."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("torch") else ["models"]
collect_ignore_glob = [] if find_spec("mitsuba") else ["models/test_xrbench_*.py"]


def pytest_report_header() -> list[str]:
    needed = (("tests/models", "torch", "train"), ("models/test_xrbench_*.py", "mitsuba", "bench"))
    return [
        f'{left_out} is left out: it needs pip install -e ".[{extra}]"'
        for left_out, module, extra in needed
        if not find_spec(module)
    ]
