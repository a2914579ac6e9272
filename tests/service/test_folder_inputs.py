"""Jobs on folders of the server: no upload, no copy, and no way out of the named folder."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.http import disparities, ended, http_server, reason_of, submit
from tests.support.models import RecallModel
from tests.support.sequences import make_frames, sequence_files, write_sequence, zip_bytes
from vergence_proto.errors import BadSequence
from vergence_service.jobs.folder_inputs import FolderInputs

FRAMES = make_frames(3)


async def test_a_job_on_a_folder_is_that_of_its_upload_and_changes_nothing(tmp_path: Path) -> None:
    room = write_sequence(tmp_path / "nas" / "drives" / "room", FRAMES)
    before = {path: path.read_bytes() for path in room.iterdir()}
    flags = {"batch__directory": tmp_path / "jobs", "batch__inputs": [f"nas={tmp_path / 'nas'}"]}
    async with http_server(RecallModel(), **flags) as client:
        uploaded = await submit(client, zip_bytes(sequence_files(FRAMES)))
        query = {"input": "file:nas/drives/room", "keep_input": "true"}
        job = (await client.post("/v1/sequences", params=query)).json()
        assert (await ended(client, job["id"]))["state"] == "done"
        again = (await client.post(f"/v1/sequences/{job['id']}/rerun")).json()
        assert (await ended(client, again["id"]))["input"] == "file:nas/drives/room"
        await ended(client, uploaded["id"])
        expected = await disparities(client, uploaded["id"])
        for each in (job, again):
            np.testing.assert_array_equal(await disparities(client, each["id"]), expected)
            assert (await client.delete(f"/v1/sequences/{each['id']}")).status_code == 204
    assert {path: path.read_bytes() for path in room.iterdir()} == before


@pytest.mark.parametrize(
    "stated",
    [
        "file:nas/../secret",
        "file:nas/link",
        "file:nas/none",
        "file:nas/\0",
        "file:other/room",
        "nas/room",
        "file:",
        "https://127.0.0.1/room.zip",
    ],
)
def test_what_is_no_folder_below_a_named_one_is_refused(stated: str, tmp_path: Path) -> None:
    write_sequence(tmp_path / "secret", FRAMES)
    (tmp_path / "nas").mkdir()
    (tmp_path / "nas" / "link").symlink_to(tmp_path / "secret")
    with pytest.raises(BadSequence) as refused:
        FolderInputs([f"nas={tmp_path / 'nas'}"]).find(stated)
    assert str(tmp_path) not in str(refused.value)


async def test_a_server_without_named_folders_reads_none() -> None:
    async with http_server(RecallModel()) as client:
        answer = await client.post("/v1/sequences", params={"input": "file:nas/room"})
        assert reason_of(answer) == "BAD_SEQUENCE"
        assert "batch.inputs" in answer.json()["detail"]
