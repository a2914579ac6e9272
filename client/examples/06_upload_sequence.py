"""A whole sequence over HTTP: upload an archive, wait for the job, download its result.

Run: ``python client/examples/06_upload_sequence.py --server http://127.0.0.1:8000``
"""

# ruff: noqa: T201  an example prints

import argparse
import io
import time
import zipfile
from importlib.resources import files
from pathlib import Path

import httpx


def main() -> None:
    """Upload the bundled sample and list the disparity files of the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--server", default="http://127.0.0.1:8000")
    server = parser.parse_args().server

    folder = Path(str(files("vergence") / "sample" / "room"))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)

    # A server on this machine is reached without the proxy that the environment may name.
    direct = {"all://127.0.0.1": None, "all://localhost": None}
    with httpx.Client(base_url=server, timeout=60.0, mounts=direct) as http:
        posted = http.post(
            "/v1/sequences",
            params={"metrics": True},  # the sample has ground truth to compare with
            content=packed.getvalue(),
            headers={"Content-Type": "application/octet-stream"},
        )
        posted.raise_for_status()
        job = posted.json()
        while job["state"] in ("queued", "running"):
            print(f"{job['state']}: {job['frames_done']} of {job['frames']} frames")
            time.sleep(1.0)
            job = http.get(f"/v1/sequences/{job['id']}").raise_for_status().json()
        if job["state"] == "failed":
            raise SystemExit(f"{job['reason']}: {job['message']}")

        result = http.get(f"/v1/sequences/{job['id']}/result", params={"format": "png16"})
        names = zipfile.ZipFile(io.BytesIO(result.raise_for_status().content)).namelist()
        print(f"{len(names)} files, {job['fps']:.1f} fps, accuracy {job['accuracy']}")
        http.delete(f"/v1/sequences/{job['id']}").raise_for_status()


if __name__ == "__main__":
    main()
