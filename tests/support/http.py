"""HTTP clients of a server in this process, and readers of its answers."""

import io
import zipfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import httpx
import numpy as np
from numpy.typing import NDArray

from tests.support.polling import eventually_true
from tests.support.server import PATIENCE_S, running_server
from vergence_proto.http_records import PROTOBUF_TYPE
from vergence_proto.jobs import JobState
from vergence_service.app.server import Running
from vergence_service.inference.model import StereoModel

ZIP = {"Content-Type": "application/zip"}
PROTOBUF = {"Content-Type": PROTOBUF_TYPE}


_ADMIN: WeakKeyDictionary[httpx.AsyncClient, str] = WeakKeyDictionary()


@asynccontextmanager
async def http_to(server: Running) -> AsyncIterator[httpx.AsyncClient]:
    async with http_at(server.http_address, server.admin_address) as client:
        yield client


@asynccontextmanager
async def http_at(address: str, admin_address: str) -> AsyncIterator[httpx.AsyncClient]:
    async with httpx.AsyncClient(base_url=f"http://{address}", timeout=PATIENCE_S) as client:
        _ADMIN[client] = admin_address
        yield client


@asynccontextmanager
async def admin_of(server: Running, **headers: str) -> AsyncIterator[httpx.AsyncClient]:
    base = f"http://{server.admin_address}"
    async with httpx.AsyncClient(base_url=base, headers=headers, timeout=PATIENCE_S) as client:
        yield client


async def metrics_of(client: httpx.AsyncClient) -> str:
    """The metrics of the client's server, which has them on another port."""
    return (await client.get(f"http://{_ADMIN[client]}/metrics")).text


@asynccontextmanager
async def http_server(model: StereoModel, **flags: Any) -> AsyncIterator[httpx.AsyncClient]:
    async with running_server(model, **flags) as server, http_to(server) as client:
        yield client


async def submit(client: httpx.AsyncClient, archive: bytes, **query: Any) -> dict[str, Any]:
    """The job of an upload that was accepted."""
    answer = await client.post("/v1/sequences", params=query, content=archive, headers=ZIP)
    assert answer.status_code == 202, answer.text
    job: dict[str, Any] = answer.json()
    return job


async def ended(client: httpx.AsyncClient, job_id: str) -> dict[str, Any]:
    """The job once it is done or failed."""
    job: dict[str, Any] = {}

    async def has_ended() -> bool:
        job.update((await client.get(f"/v1/sequences/{job_id}")).json())
        return JobState(job["state"]).ended

    await eventually_true(has_ended)
    return job


async def state_of(client: httpx.AsyncClient, job_id: str) -> str:
    return str((await client.get(f"/v1/sequences/{job_id}")).json()["state"])


async def is_known(client: httpx.AsyncClient, job_id: str) -> bool:
    return (await client.get(f"/v1/sequences/{job_id}")).status_code == httpx.codes.OK


async def disparities(client: httpx.AsyncClient, job_id: str) -> list[NDArray[np.float32]]:
    answer = await client.get(f"/v1/sequences/{job_id}/result", params={"format": "npz"})
    assert answer.status_code == 200, answer.text
    return disparities_in(answer.content)


def disparities_in(archive: bytes) -> list[NDArray[np.float32]]:
    """The maps in a result, a zip of npz files, in order."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        names = sorted(name for name in file.namelist() if name.endswith(".npz"))
        return [np.load(io.BytesIO(file.read(name)))["disparity"] for name in names]


def as_kept(disparity_px: Any) -> NDArray[np.float32]:
    """Maps of a live stream as jobs keep them: rounded to 1/64 px, none below half of that."""
    stored = np.rint(np.asarray(disparity_px, np.float32) * 64)
    return np.asarray(np.where(stored == 0, np.nan, stored / 64), np.float32)


def reason_of(answer: httpx.Response) -> str:
    """The reason of a refusal, which must be problem details."""
    assert answer.headers["Content-Type"] == "application/problem+json", answer.text
    problem = answer.json()
    assert problem["status"] == answer.status_code
    assert problem["detail"]
    return str(problem["reason"])


def files_below(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def pair_form() -> dict[str, tuple[str, io.BytesIO, str]]:
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    png = cv2.imencode(".png", image)[1].tobytes()
    return {name: (name, io.BytesIO(png), "image/png") for name in ("left", "right")}
