"""A client that was generated from the OpenAPI document works as it is."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.http import http_server
from tests.support.models import RecallModel
from tests.support.sequences import make_frames, sequence_files, zip_bytes

GENERATOR = "openapi-python-client==0.29.1"
FRAMES = 3
PROGRAM = """
import io, sys, time, zipfile
from generated import Client
from generated.api.sequences import (
    delete_sequence, get_frame, get_manifest, get_result, get_sequence, list_frames, submit_sequence
)
from generated.models import JobOutput, ResultFormat
from generated.types import File

client = Client(base_url=sys.argv[1], raise_on_unexpected_status=True)
with open(sys.argv[2], "rb") as archive:
    job = submit_sequence.sync(
        client=client, body=File(payload=archive), output=[JobOutput.DEPTH], name="drive"
    )
while job.state.value not in ("done", "failed"):
    time.sleep(0.1)
    job = get_sequence.sync(job.id, client=client)
assert (job.state.value, job.name) == ("done", "drive"), job
result = get_result.sync(job.id, client=client, format_=ResultFormat.NPZ)
names = zipfile.ZipFile(io.BytesIO(result.payload.read())).namelist()
lines = list_frames.sync(job.id, client=client)
assert len(lines.payload.read().splitlines()) == int(sys.argv[3])
assert get_frame.sync(job.id, 0, client=client).payload.read()
assert get_manifest.sync(job.id, client=client)["id"] == job.id
problem = get_sequence.sync("nothing", client=client)
assert problem.reason.value == "SEQUENCE_UNKNOWN", problem
delete_sequence.sync_detailed(job.id, client=client)
print(sum(name.endswith(".npz") for name in names))
"""


@pytest.mark.slow
async def test_a_generated_client_submits_a_job_and_fetches_its_result(tmp_path: Path) -> None:
    def run(*command: str | Path) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=clean, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    # Its own environment: neither our packages nor our versions of others.
    hidden = ("PYTHONPATH", "PIP_CONSTRAINT")
    clean = {name: value for name, value in os.environ.items() if name not in hidden}
    archive = tmp_path / "room.zip"
    archive.write_bytes(zip_bytes(sequence_files(make_frames(FRAMES))))
    (tmp_path / "program.py").write_text(PROGRAM)
    python = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin") / "python"
    async with http_server(RecallModel()) as client:
        (tmp_path / "openapi.json").write_bytes((await client.get("/openapi.json")).content)
        await asyncio.to_thread(run, sys.executable, "-m", "venv", tmp_path / "env")
        await asyncio.to_thread(run, python, "-m", "pip", "install", "--quiet", GENERATOR)
        generate = ("generate", "--path", "openapi.json", "--output-path", "generated")
        made = await asyncio.to_thread(
            run, python, "-m", "openapi_python_client", *generate, "--meta", "none"
        )
        written = await asyncio.to_thread(
            run, python, "program.py", str(client.base_url), archive, str(FRAMES)
        )
    assert int(written) == FRAMES
    # Every operation of sequences is in the client, but for parts of uploads, which are tus's.
    missing = [line for line in made.splitlines() if "Endpoint will not be generated" in line]
    assert all("PATCH /v1/uploads" in line or "/v1/streams" in line for line in missing), made
