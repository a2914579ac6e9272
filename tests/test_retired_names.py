"""Names that were retired stay retired: one word for one thing, in code and in tests."""

import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("client", "models", "proto", "service", "tests")

# Old name, and the name that replaced it. Whole identifiers, not parts of them.
RETIRED = {
    "Answered": "AnsweredFrame",
    "Answers": "ResponseRouter",
    "CloserLook": "RefinementAt2x",
    "Clues": "CostFeatures",
    "Contender": "StudiedNetwork",
    "Evidence": "MatchingFeatures",
    "Flights": "FramesInFlight",
    "Guess": "CoarseEstimate",
    "HttpFace": "HttpTransport",
    "JobShelf": "JobRegistry",
    "LAYOUTS": "DATASETS",
    "LayoutError": "DatasetError",
    "Letter": "QueuedFrame",
    "LinkUser": "StreamListener",
    "LiveRhythm": "ArrivalPredictor",
    "Opening": "StreamConfig",
    "OutputKind": "Output",
    "PIECE_BYTES": "SHARD_BYTES",
    "Resident": "DeviceTensor",
    "ResultForm": "ResultFormat",
    "StagedGraphs": "GraphRunner",
    "Tally": "MetricAccumulator",
    "TimedResult": "Timings",
    "Trouble": "CliError",
    "Undeclarable": "Declaration",
    "ZenohFace": "ZenohTransport",
    "ZenohPeer": "ZenohSession",
    "ask_key": "query_key",
    "closer_look": "refine_at_2x",
    "declare_alive": "declare_liveliness",
    "depth_call": "stream_call",
    "displaces": "drop_oldest",
    "feeding": "batches",
    "foreign_share": "cutmix_share",
    "http_face": "app.http",
    "http_form": "forms",
    "job_queue": "jobs.queue",
    "job_run": "jobs.run",
    "job_shelf": "jobs.registry",
    "job_worker": "jobs.worker",
    "layouts": "datasets",
    "looks_closer": "refines_at_2x",
    "next_due": "next_expected",
    "on_zenoh": "serving_zenoh",
    "open_apart": "offline",
    "opening_of": "job_stream_config",
    "partly_foreign": "cutmix_state",
    "put_away": "finish",
    "put_own": "put_local",
    "step_apart": "step_offline",
    "stream_table": "streams.table",
    "taken_bytes": "used_bytes",
    "tell_lost": "report_lost",
    "vergence_layout": "vergence_format",
    "view_of": "view_from_frame",
    "watch_deaths": "watch_liveliness",
    "zenoh_face": "app.zenoh",
    "zenoh_inbox": "zenoh.inbox",
    "zenoh_peer": "zenoh.session",
}


ANY_OF_THEM = re.compile(rf"\b({'|'.join(RETIRED)})\b")


def identifiers(path: Path) -> set[str]:
    with path.open("rb") as file:
        return {
            token.string
            for token in tokenize.tokenize(file.readline)
            if token.type == tokenize.NAME
        }


def mentioned(path: Path) -> bool:
    """Whether a name is in the file at all: few files have one, and few need to be parsed."""
    return ANY_OF_THEM.search(path.read_text("utf-8")) is not None


def test_no_retired_name_is_used() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {old} is now {RETIRED[old]}"
        for folder in FOLDERS
        for path in filter(mentioned, sorted((ROOT / folder).rglob("*.py")))
        for old in sorted(identifiers(path) & RETIRED.keys())
    ]
    assert not found


def test_no_name_is_both_old_and_new() -> None:
    assert not RETIRED.keys() & set(RETIRED.values())
