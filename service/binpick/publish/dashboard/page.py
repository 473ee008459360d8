"""One open page: panels whose content is replaced when the cell's snapshot changes it."""

import time
from collections.abc import Callable
from contextlib import aclosing
from pathlib import Path

from nicegui import background_tasks, ui

from binpick.health import Health
from binpick.publish.dashboard import panels, trend, views, words
from binpick.publish.events import snapshots
from binpick.publish.ports import View
from binpick.result import Published, Snapshot

STYLE = Path(__file__).with_name("style.css")
KEPT = 16
"""Results a view remembers: how far back to look for the last one with pictures."""


class Page:
    """Built once per browser tab; follows the cell until the tab or the cell is gone."""

    def __init__(self, view: View, health: Callable[[], Health]) -> None:
        self._view, self._health = view, health
        self._panels: dict[str, ui.html] = {}
        self._images: dict[str, ui.element] = {}
        self._pictured: Published | None = None

    def open(self) -> None:
        """Lays the page out in NiceGUI's current client and starts following."""
        ui.add_css(STYLE)
        with ui.element("main").classes("cell"):
            self._panel("banner")
            with ui.element("section").classes("pictures"):
                self._image("overlay.png")
                self._image("left.png")
                self._panel("caption")
            with ui.element("section").classes("facts"):
                self._panel("result")
                self._panel("grasps")
                with ui.element("div").classes("pair"):
                    self._panel("funnel")
                    self._panel("timings")
            with ui.element("section").classes("foot"):
                self._panel("cameras")
                self._panel("calibration")
                self._panel("counts")
        self._show(self._view.snapshot())
        following = background_tasks.create(self._follow(), name="binpick-page")
        ui.timer(1.0, self._tell_age)
        ui.context.client.on_delete(lambda: following.cancel())

    def _panel(self, name: str) -> None:
        # the content is made in panels.py, where everything that did not come from there is escaped
        self._panels[name] = ui.html("", sanitize=False).classes(f"panel {name}").mark(name)

    def _image(self, name: str) -> None:
        # <img>, not ui.image, which would put the mount's path before the address
        self._images[name] = ui.element("img").props(f'alt="{name}"').classes(f"picture {Path(name).stem}")
        self._images[name].set_visibility(False)

    async def _follow(self) -> None:
        async with aclosing(snapshots(self._view)) as changes:
            async for snapshot in changes:
                self._show(snapshot)

    def _show(self, snapshot: Snapshot) -> None:
        health = self._health()
        content = {
            "banner": panels.banner(words.banner(snapshot, health), snapshot), "result": panels.result(snapshot),
            "grasps": views.panel(snapshot) or panels.grasps(snapshot),
            "funnel": panels.funnel(snapshot), "timings": panels.timings(snapshot),
            "cameras": panels.cameras(snapshot), "counts": panels.counts(snapshot), "calibration": trend.panel(snapshot)}
        for name, markup in content.items():
            self._panels[name].set_content(markup)
        self._picture(snapshot)

    def _picture(self, snapshot: Snapshot) -> None:
        """Points the images at the last cycle that took any; the browser fetches them, and shows the old ones until then."""
        latest = snapshot.latest.result.cycle_id if snapshot.latest else 0
        known = self._pictured.result.cycle_id if self._pictured else 0
        for cycle_id in range(latest, max(known, latest - KEPT), -1):
            published = self._view.finished(cycle_id)
            if published is not None and published.result.captured_at is not None:
                self._pictured = published
                for name, image in self._images.items():
                    # the boot tells this cycle's address from that of another run, which a browser may hold
                    image.props(f'src="/v1/cycles/{cycle_id}/{name}?boot={snapshot.boot_id}"').set_visibility(True)
                break
        self._tell_age()

    def _tell_age(self) -> None:
        self._panels["caption"].set_content(panels.caption(self._pictured, time.monotonic_ns()))
