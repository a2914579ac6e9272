"""Any part of an archive is that part of the whole, and wrong parts are refused."""

from collections.abc import AsyncIterator

import httpx
import pytest

from tests.support.http import ended, http_server, submit
from tests.support.models import NOT_FINITE, RecallModel
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from vergence_proto.jobs import ResultFormat

FORMATS = [form for form in ResultFormat if form is not ResultFormat.MP4]


@pytest.fixture
async def client() -> AsyncIterator[httpx.AsyncClient]:
    async with http_server(RecallModel()) as client:
        yield client


async def result_of(client: httpx.AsyncClient) -> str:
    """The address of a result; its third frame has no map."""
    frames = make_frames(4)
    frames[2].left[0, 0] = NOT_FINITE
    archive = zip_bytes(sequence_files(frames))
    job = await submit(client, archive, output=["disparity", "sigma", "left"])
    assert (await ended(client, job["id"]))["frames_failed"] == 1
    return f"/v1/sequences/{job['id']}/result"


async def test_parts_of_an_archive_are_those_of_the_whole(client: httpx.AsyncClient) -> None:
    url = await result_of(client)
    for form in FORMATS:
        query = {"format": form.value}
        # Before anything was sent: a part of an archive that nobody has measured.
        end = await client.get(url, params=query, headers={"Range": "bytes=-100"})
        whole = await client.get(url, params=query)
        size, tag = len(whole.content), whole.headers["ETag"]
        assert whole.headers["Content-Length"] == str(size)
        assert end.content == whole.content[-100:]
        assert end.headers["Content-Range"] == f"bytes {size - 100}-{size - 1}/{size}"
        for start, last in ((0, 0), (1, size // 3), (size // 2, size - 2), (size - 1, size + 9)):
            asked = {"Range": f"bytes={start}-{last}", "If-Range": tag}
            part = await client.get(url, params=query, headers=asked)
            assert part.status_code == httpx.codes.PARTIAL_CONTENT
            assert part.headers["ETag"] == tag
            assert part.content == whole.content[start : last + 1], (form, start)
    head = await client.head(url, params={"format": "npz"})
    assert int(head.headers["Content-Length"]) > 0
    assert not head.content


async def test_an_archive_is_the_same_whether_it_was_measured_or_not(
    client: httpx.AsyncClient,
) -> None:
    url = await result_of(client)
    first = await client.get(url)  # encoded while it is sent: its size is not known yet
    assert "Content-Length" not in first.headers
    again = await client.get(url)
    assert again.content == first.content
    assert again.headers["ETag"] == first.headers["ETag"]
    known = await client.get(url, headers={"If-None-Match": first.headers["ETag"]})
    assert known.status_code == httpx.codes.NOT_MODIFIED
    other = await client.get(url, headers={"Range": "bytes=5-", "If-Range": '"another"'})
    assert (other.status_code, other.content) == (httpx.codes.OK, first.content)


@pytest.mark.parametrize("name", ["result", "result?format=mp4", "frames/0", "frames/0/depth.pfm"])
async def test_a_range_past_the_end_is_a_problem(client: httpx.AsyncClient, name: str) -> None:
    url = (await result_of(client)).removesuffix("result") + name
    size = len((await client.get(url)).content)
    asked = {"Range": f"bytes={size - 2}-{size - 1}"}
    part = await client.get(url, headers=asked)
    assert (part.status_code, len(part.content)) == (httpx.codes.PARTIAL_CONTENT, 2)
    for past in (f"bytes={size}-", "bytes=9-8", "bytes=-0"):
        refused = await client.get(url, headers={"Range": past})
        assert refused.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE
        assert refused.headers["Content-Range"] == f"bytes */{size}"
        assert refused.headers["Content-Type"] == "application/problem+json"
        assert str(size) in refused.json()["detail"]
