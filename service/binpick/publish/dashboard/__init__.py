"""The page at /ui: the cell's state for whoever stands in front of it, read-only, without a line of JavaScript of ours."""

from collections.abc import Callable

from fastapi import FastAPI
from fastapi.responses import RedirectResponse
from nicegui import ui

from binpick.health import Health
from binpick.publish.dashboard.page import Page
from binpick.publish.ports import View

MOUNT = "/ui"
FAVICON = ('<svg viewBox="0 0 32 32" xmlns="http://www.w3.org/2000/svg"><path d="M3 9h26l-4 20H7z" fill="#2ea043"/>'
           '<circle cx="16" cy="17" r="5" fill="none" stroke="#fff" stroke-width="3"/></svg>')


def attach(app: FastAPI, view: View, health: Callable[[], Health]) -> None:
    """Mounts the page on the app and sends / to it. Once per process: NiceGUI keeps its own app in a module."""
    for path in ("/", MOUNT):
        app.add_api_route(path, _to_the_page, include_in_schema=False)
    # our style sheet is all the page needs: without Tailwind's compiler a wall display loads and idles lighter
    ui.run_with(app, root=lambda: Page(view, health).open(), mount_path=MOUNT, title="binpick", dark=True, favicon=FAVICON,
                show_welcome_message=False, tailwind=False, binding_refresh_interval=None,
                gzip_middleware_factory=None)


def _to_the_page() -> RedirectResponse:
    return RedirectResponse(f"{MOUNT}/")
