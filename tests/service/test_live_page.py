"""The live page, in a real Chromium: what it shows, whom it lets in, and what it loads."""

import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright, expect

from tests.support.frames import frame_message, make_frame, open_message
from tests.support.models import RecallModel
from tests.support.server import PATIENCE_S, RawCall, raw_stream, running_server
from tests.support.tokens import TokenFile, stub
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
