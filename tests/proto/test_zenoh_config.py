"""A Zenoh file keeps the project's own settings, unless it sets them."""

import json
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from vergence_proto.zenoh.json5_keys import keys_of
from vergence_proto.zenoh.session import make_config

NAMES = st.text("abcdefg_:{}[],/ \"'", min_size=1, max_size=6).filter(lambda name: "/" not in name)
OBJECTS: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8),
    lambda values: st.dictionaries(NAMES, values, max_size=4) | st.lists(values, max_size=3),
)
LEASE = "transport/link/tx/lease"
MULTICAST = "scouting/multicast/enabled"


def paths(value: Any, above: str = "") -> list[str]:
    if not isinstance(value, dict):
        return []
    found = []
    for key, inner in value.items():
        path = f"{above}/{key}" if above else key
        found += [path, *paths(inner, path)]
    return found


@given(st.dictionaries(NAMES, OBJECTS, max_size=4))
def test_the_keys_of_json_are_found(value: dict[str, Any]) -> None:
    # JSON is JSON5. Names with quotes are escaped there, and stay so here.
    escaped = [json.dumps(path)[1:-1] for path in paths(value)]
    assert list(keys_of(json.dumps(value))) == escaped


def test_comments_and_names_without_quotes_are_read() -> None:
    text = """
    // lease: 1
    { /* transport: {link: 2} */ transport: {'link': {tx: {lease: 3000,},},}, connect: {
        endpoints: ["tcp/10.0.0.1:7447", {a: 1}] } }
    """
    assert {*keys_of(text)} == {
        *("transport", "transport/link", "transport/link/tx", LEASE, "connect"),
        "connect/endpoints",
    }


def test_a_file_keeps_our_settings_unless_it_sets_them(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{transport: {link: {tx: {lease: 10000}}}} // Zenoh's own default", "utf-8")
    config = make_config(file, max_message_bytes=1 << 20)
    assert config.get_json(LEASE) == "10000"
    assert config.get_json(MULTICAST) == "false"
    retry = json.loads(config.get_json("connect/retry"))
    assert retry["period_max_ms"] == 500

    file.write_text("{connect: {retry: {period_max_ms: 9000}}, scouting: {multicast: {}}}", "utf-8")
    config = make_config(file, max_message_bytes=1 << 20)
    assert config.get_json(LEASE) == "5000"
    assert json.loads(config.get_json("connect/retry"))["period_max_ms"] == 9000
