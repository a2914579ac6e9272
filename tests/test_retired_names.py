"""Names that were retired stay retired: one word for one thing, in code and in tests."""

import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("client", "models", "proto", "service", "tests")

# Old name, and the name that replaced it. Whole identifiers, not parts of them.
RETIRED = {
    "DATASETS": "DATASETS",
    "DatasetError": "DatasetError",
    "OutputKind": "Output",
    "ResultForm": "ResultFormat",
    "Undeclarable": "Declaration",
    "ZenohPeer": "ZenohSession",
    "ask_key": "query_key",
    "declare_alive": "declare_liveliness",
    "depth_call": "stream_call",
    "displaces": "drop_oldest",
    "feeding": "batches",
    "http_face": "app.http",
    "http_form": "forms",
    "job_queue": "jobs.queue",
    "job_run": "jobs.run",
    "job_shelf": "jobs.registry",
    "job_worker": "jobs.worker",
    "layouts": "datasets",
    "put_own": "put_local",
    "stream_table": "streams.table",
    "vergence_layout": "vergence_format",
    "watch_deaths": "watch_liveliness",
    "zenoh_face": "app.zenoh",
    "zenoh_inbox": "zenoh.inbox",
    "zenoh_peer": "zenoh.session",
}


def identifiers(path: Path) -> set[str]:
    with path.open("rb") as file:
        return {
            token.string
            for token in tokenize.tokenize(file.readline)
            if token.type == tokenize.NAME
        }


def test_no_retired_name_is_used() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {old} is now {RETIRED[old]}"
        for folder in FOLDERS
        for path in sorted((ROOT / folder).rglob("*.py"))
        for old in sorted(identifiers(path) & RETIRED.keys())
    ]
    assert not found


def test_no_name_is_both_old_and_new() -> None:
    assert not RETIRED.keys() & set(RETIRED.values())
