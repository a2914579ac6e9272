"""The tables in proto/README.md equal the code."""

from pathlib import Path

import numpy as np
import pytest

from vergence_proto.datasets import DATASETS
from vergence_proto.errors import ErrorCode
from vergence_proto.geometry import Axes
from vergence_proto.zenoh.keys import OPEN, UNARY_KEYS, StreamKeys, query_key, server_key
from vergence_service.transports.grpc.errors import GRPC_STATUS
from vergence_service.transports.http.errors import HTTP_STATUS

README = Path(__file__).parents[2] / "proto" / "README.md"
# Each word for a direction, in OpenCV axes.
DIRECTIONS = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "down": (0, 1, 0),
    "up": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}


def table(section: str) -> list[list[str]]:
    """The cells of the first table after a heading or a bold word, without its head."""
    text = README.read_text("utf-8").split(section, 1)[1]
    rows = text[text.index("\n|") :].strip().split("\n\n")[0].splitlines()
    return [[cell.strip().strip("`") for cell in row.strip("|").split("|")] for row in rows[2:]]


def test_the_table_of_errors_equals_the_code() -> None:
    written = {code: (grpc, int(http)) for code, grpc, http, _ in table("## Errors")}
    assert written == {code: (GRPC_STATUS[code].name, HTTP_STATUS[code]) for code in ErrorCode}


def test_every_error_says_what_to_do() -> None:
    assert all(action for *_, action in table("## Errors"))


@pytest.mark.parametrize("axes", Axes, ids=lambda axes: axes.name)
def test_the_table_of_axes_equals_the_code(axes: Axes) -> None:
    rows = {name: (words, handedness) for name, *words, handedness in table("**Axes.**")}
    words, handedness = rows[axes.name]
    opencv_from_axes = np.array([DIRECTIONS[word] for word in words]).T
    np.testing.assert_array_equal(opencv_from_axes, axes.value)
    assert (np.linalg.det(opencv_from_axes) > 0) == (handedness == "right")


def test_the_table_of_data_sets_equals_the_code() -> None:
    assert [kind for kind, *_ in table("## Data sets")] == list(DATASETS)


def test_the_table_of_zenoh_keys_equals_the_code() -> None:
    stream = StreamKeys("NS", "PLACE", "STREAM")
    unary = "{" + ",".join(UNARY_KEYS.values()) + "}"
    assert [key for key, *_ in table("## Zenoh keys")] == [
        server_key("NS", "SERVER"),
        query_key("NS", "PRINCIPAL", "SERVER", OPEN),
        query_key("NS", "PRINCIPAL", "SERVER", unary),
        stream.client("ATTACHMENT"),
        stream.frames,
        stream.disparity,
        stream.status,
    ]
