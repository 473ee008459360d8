"""The page in a real browser over a real daemon: ready, then the result; nothing from elsewhere; gone when the daemon stops."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, expect, sync_playwright

CELL = Path(__file__).parents[1] / "page_cell.py"
CHROMIUM = Path("/usr/bin/chromium")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
START_S = 40
"""Libraries, a world of six parts, two cameras: a few seconds, more on a busy machine."""

pytestmark = [pytest.mark.browser, pytest.mark.slow,
              pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium")]


@pytest.fixture
def daemon(free_port: int) -> Iterator[tuple[subprocess.Popen[str], str]]:
    process = subprocess.Popen([sys.executable, str(CELL), str(free_port), "6"], stdout=subprocess.PIPE, text=True)
    url = f"http://127.0.0.1:{free_port}"
    try:
        deadline = time.monotonic() + START_S
        while not _ready(url):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        yield process, url
    finally:
        process.kill()
        process.communicate()


def _ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/v1/health/ready", timeout=5).status_code == 200
    except httpx.TransportError:
        return False


@pytest.fixture
def page() -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        page = browser.new_page(viewport={"width": 1920, "height": 1080})
        page.set_default_timeout(20_000)
        yield page
        browser.close()


def test_shows_ready_then_the_result_and_ends_with_the_daemon(daemon: tuple[subprocess.Popen[str], str], page: Page,
                                                              clock: Callable[[], float]) -> None:
    process, url = daemon
    asked, failed = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("response", lambda response: failed.append(response.url) if response.status >= 400 else None)
    page.on("pageerror", lambda error: failed.append(str(error)))
    expect.set_options(timeout=20_000)

    page.goto(f"{url}/")
    assert page.url == f"{url}/ui/"
    expect(page.locator("header.good b")).to_have_text("READY")
    expect(page.get_by_text("waiting for a trigger over REST")).to_be_visible()
    expect(page.get_by_text("SIMULATED", exact=True)).to_be_visible()
    expect(page.get_by_text("No cycle has run yet.").first).to_be_visible()

    result = httpx.post(f"{url}/v1/cycles", params={"wait": True}, json={}, timeout=40).json()
    expect(page.locator(".answer p")).to_have_text(result["return_code"]["message"])
    expect(page.locator(".answer small")).to_contain_text("cycle 1")
    expect(page.locator("tbody tr")).to_have_count(min(len(result["grasps"]), 6))
    expect(page.locator(".funnel li")).not_to_have_count(0)
    page.wait_for_function("document.querySelector('img.overlay').naturalWidth > 500")
    page.wait_for_function("document.querySelector('img.left').naturalWidth == 1936")

    assert failed == []
    assert [address for address in asked if not address.startswith(url)] == []
    assert any("/v1/cycles/1/overlay.png" in address for address in asked)

    stopped = clock()
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert clock() - stopped < 3
    expect(page.locator("header b")).to_have_text("STOPPING")
