"""The live page, in a real Chromium: what it shows, whom it lets in, and what it loads."""

import re
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import cv2
import pytest
from playwright.async_api import Page, async_playwright, expect

from tests.support.frames import RIG, frame_message, make_frame, open_message
from tests.support.http import ended, submit
from tests.support.models import RecallModel
from tests.support.polling import eventually
from tests.support.sequences import make_frames, sequence_files, zip_bytes
from tests.support.server import PATIENCE_S, RawCall, raw_stream, running_server
from tests.support.tokens import TokenFile, http_as, stub
from vergence_proto import codec
from vergence_service.app.server import Running

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]


@asynccontextmanager
async def browsing(server: Running) -> AsyncIterator[Page]:
    """A page of the administrator's port. No message of the console, no request elsewhere."""
    base = f"http://{server.admin_address}"
    complaints: list[str] = []
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(base_url=base)
        page.set_default_timeout(1000 * PATIENCE_S)
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith((f"{base}/", "data:"))
                else complaints.append(request.url)
            ),
        )
        yield page
        await browser.close()
    assert complaints == []


async def test_the_page_shows_each_stream_with_its_failures_and_follows_it() -> None:
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server, "headset-1") as call,
        browsing(server) as page,
    ):
        await call.ask(frame_message(make_frame(2)))
        await call.ask(frame_message(make_frame(1)))  # out of order
        await page.goto("/")
        row = page.locator("#streams tr")
        await expect(row).to_have_count(1)
        await expect(row).to_contain_text("headset-1")
        await expect(row).to_contain_text("64x48")
        await expect(row).to_contain_text("1 frame out of order")
        await expect(page.locator("#health")).to_have_text("serving")
        await expect(page.locator("#principals tr")).to_contain_text("local")
        await expect(page.locator("#refusals")).to_contain_text("FRAME_OUT_OF_ORDER")
        async with raw_stream(server, "headset-2"):
            await expect(row).to_have_count(2)
        await page.goto("/docs")
        await expect(page.locator("table")).to_contain_text("/v1/pairs")


async def colours_of(page: Page, canvas: str) -> int:
    """How many colours a canvas shows; one that nothing was drawn on has one."""
    counted = """canvas => {
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        return new Set(new Uint32Array(data.buffer)).size;
    }"""
    return int(await page.locator(canvas).evaluate(counted))


async def test_a_stream_is_shown_live_with_the_depth_under_the_pointer() -> None:
    async with (
        running_server(RecallModel()) as server,
        raw_stream(server, "headset-1") as call,
        browsing(server) as page,
    ):
        await page.goto("/")
        await page.click("text=headset-1")
        await expect(page.locator("h1")).to_have_text("headset-1")
        for frame_id in range(1, 4):
            await eventually(lambda: server.engine.viewers.count == 1)
            answer = await call.ask(frame_message(make_frame(frame_id)))
        await expect(page.locator("#status")).to_contain_text("frame 3, warm for 2 frames")
        for canvas in ("#image", "#cloud"):
            assert await colours_of(page, canvas) > 100
        await page.locator("#disparity").hover()
        readout = page.locator("#readout")
        await expect(readout).to_contain_text("expected error")
        found = re.fullmatch(
            r"column (\d+), row (\d+): ([\d.]+) m, .* disparity ([\d.]+) px, .*",
            await readout.inner_text(),
        )
        assert found
        column, row, depth_m, disparity_px = map(float, found.groups())
        planes = codec.received_planes_from_proto(answer.disparity, RIG)
        expected_px = planes.disparity_px[int(row), int(column)]
        assert disparity_px == pytest.approx(expected_px, abs=0.02)
        assert depth_m == pytest.approx(RIG.fx * RIG.baseline_m / expected_px, rel=0.01)


async def test_two_images_give_their_depth(tmp_path: Path) -> None:
    frame = make_frame(1)
    for name, image in {"left": frame.left, "right": frame.right}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    async with running_server(RecallModel()) as server, browsing(server) as page:
        await page.goto("/")
        await page.click("text=depth of a pair")
        await page.set_input_files("#left", tmp_path / "left.png")
        await page.set_input_files("#right", tmp_path / "right.png")
        await page.fill("#fx_px", "60")
        await page.fill("#baseline_m", "0.1")
        await page.click("text=Show depth")
        await expect(page.locator("#status")).to_have_text("left.png and right.png, 64x48")
        assert await colours_of(page, "#image") > 100
        await page.locator("#sigma").hover()
        await expect(page.locator("#readout")).to_contain_text("m, expected error")


async def test_a_job_shows_its_progress_and_an_administrator_downloads_it(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens", "ana", admins=("root",))
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        http_as(server, file.shown("ana")) as hers,
        browsing(server) as page,
    ):
        job = await submit(hers, zip_bytes(sequence_files(make_frames(2))), name="drive 17")
        await ended(hers, job["id"])
        await page.goto("/")
        await page.fill("input[name=token]", file.tokens["root"])
        await page.click("button")
        row = page.locator("#sequences tr")
        await expect(row).to_contain_text("drive 17")
        await expect(row).to_contain_text("2 of 2")
        async with page.expect_download() as downloading:
            await row.locator("text=npz").click()
        await (await downloading.value).save_as(tmp_path / "result.zip")
        expected = await hers.get(f"/v1/sequences/{job['id']}/result?format=npz")
        assert (tmp_path / "result.zip").read_bytes() == expected.content


async def test_with_tokens_an_administrator_logs_in_and_out(tmp_path: Path) -> None:
    file = TokenFile(tmp_path / "tokens", "ana", admins=("root",))
    async with (
        running_server(RecallModel(), security__tokens=file.path) as server,
        stub(server) as calls,
        browsing(server) as page,
    ):
        call = RawCall(calls.StreamDepth(metadata=tuple(file.shown("ana").items())))
        await call.ask(open_message("hers"))
        await page.goto("/")
        assert page.url.endswith("/login")
        await page.fill("input[name=token]", file.tokens["root"])
        await page.click("button")
        await expect(page.locator("#streams tr")).to_contain_text("hers")
        await expect(page.locator("#principals tr")).to_contain_text("ana")
        await page.click("text=Log out")
        assert page.url.endswith("/login")
        await page.goto("/")
        assert page.url.endswith("/login")
