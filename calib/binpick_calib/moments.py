"""Moments: the images of one instant as they come, from cameras of our own, a running daemon, or a folder that fills up."""

import contextlib
import functools
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

from binpick.camera import backends, exposure
from binpick.data import Image, Light, StereoPair
from binpick.errors import CameraError, ImageError, InputError, NotReady
from binpick.settings import Cell
from binpick.settings.recipe import Recipe
from binpick_calib import views as viewing

SHOT_NS = 5_000_000_000
PAUSE_S = 0.3
"""Between two looks: long enough for a hand to give itself away, short enough to follow it."""
PATIENCE_S = 70.0
"""For the daemon's answer: a cell file may allow its cycles a minute."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One image of each camera, in the rig's order. `live`: the next one shows the same scene a little later.

    `forget` is called when the moment is not taken.
    """

    images: tuple[Image, ...]
    name: str
    live: bool
    forget: Callable[[], None] = lambda: None


Moments = Generator[Moment | str, None, None]
"""A string says why there is nothing to look at just now."""


def of_cameras(cell: Cell) -> Moments:
    """Without the pattern, at the first recipe's exposure. Raises CameraError when the cameras cannot be opened at first."""
    group, recipe = backends.group(cell.cameras), cell.recipes[0]
    light = replace(recipe.lights[0], projector=False, pattern=0)
    search = _limits(recipe).begin(light.exposure_us) if light.metered else None
    opened = False
    try:
        while True:
            try:
                group.open(time.monotonic_ns() + SHOT_NS)
                opened = True
                pair = group.capture(light, time.monotonic_ns() + SHOT_NS)
            except CameraError as error:
                if not opened:
                    raise
                yield str(error)
                time.sleep(PAUSE_S)
                continue
            if search is not None:
                search, light = _metered(search, pair, light, recipe)
                if not search.outcome:
                    yield f"setting the exposure: {light.exposure_us:.0f} µs"
                    continue
            yield Moment(tuple(frame.image for frame in pair.frames), pair.captured_at, live=True)
            time.sleep(PAUSE_S)
    finally:
        group.close()


def _limits(recipe: Recipe) -> exposure.Limits:
    return exposure.Limits(50.0, recipe.auto.longest_us, recipe.gain_db, recipe.auto.highest_gain_db)


def _metered(search: exposure.Search, pair: StereoPair, light: Light, recipe: Recipe) -> tuple[exposure.Search, Light]:
    """One step of auto exposure by the whole images; it begins anew when the light has changed."""
    level = exposure.level(tuple(frame.image for frame in pair.frames), recipe.auto.percentile)
    if search.outcome:
        if not exposure.drifted(search, level, recipe.auto):
            return search, light
        search = exposure.Search(search.exposure_us, search.gain_db)
    search = exposure.step(search, level, recipe.auto, _limits(recipe))
    return search, replace(light, exposure_us=search.exposure_us, gain_db=search.gain_db)


def of_folder(left: str, right: str) -> Moments:
    """Pairs by the number in their names, as `solve` finds them, each once; waits for more when all have been seen."""
    done: set[tuple[Path | None, ...]] = set()
    while True:
        fresh: list[viewing.Shot] = []
        waiting = f"waiting for images {left} and {right}"
        try:
            fresh = [shot for shot in viewing.match(left, right)[0] if shot.files not in done]
        except InputError as error:       # nothing there yet, half a pair, or names that will never do
            waiting = f"{waiting}: {error}"
        for shot in fresh:
            images = [viewing.read(path) for path in shot.files if path is not None]
            if any(image is None for image in images):
                yield f"{shot.files[0]} or its partner cannot be read yet"
                continue
            done.add(shot.files)
            yield Moment(tuple(image for image in images if image is not None), str(shot.number), live=False)
        if not fresh:
            yield waiting
            time.sleep(PAUSE_S)


def of_daemon(client: httpx.Client, board: str) -> Moments:
    """Samples that a running daemon takes with its cameras; those that are not taken are deleted there again.

    Closes the client when it ends. Raises InputError when it refuses for good.
    """
    with contextlib.closing(client):
        while True:
            try:
                answer = asked(client, "POST", "/v1/calibration/samples", json={"board": board}).json()
                sample = answer["sample"]
                where = f"/v1/calibration/samples/{sample['id']}"
                images = tuple(_image(asked(client, "GET", f"{where}/{sighting['camera']}.png").content)
                               for sighting in sample["sightings"])
            except (httpx.TransportError, NotReady) as error:
                yield f"the daemon at {client.base_url}: {error}"
                time.sleep(PAUSE_S)
                continue
            yield Moment(images, f"sample {sample['id']}", live=True, forget=functools.partial(_forget, client, where))
            time.sleep(PAUSE_S)


def _forget(client: httpx.Client, where: str) -> None:
    with contextlib.suppress(httpx.TransportError, NotReady):
        asked(client, "DELETE", where)


def asked(client: httpx.Client, verb: str, path: str, **body: Any) -> httpx.Response:
    """The answer. Raises NotReady when it is busy or its cameras fail, InputError when it says that the request is wrong."""
    response = client.request(verb, path, **body)
    if response.is_success:
        return response
    try:
        said = response.json().get("detail", response.reason_phrase)
    except ValueError:
        said = response.reason_phrase
    raise (NotReady if response.status_code in (409, 503, 504) else InputError)(f"{said} ({response.status_code})")


def _image(content: bytes) -> Image:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ImageError("the daemon sent something that is no image")
    return np.asarray(image, np.uint8)


def daemon(url: str) -> httpx.Client | None:
    """A client of the daemon that answers there; None when none does."""
    client = httpx.Client(base_url=url, timeout=PATIENCE_S, trust_env=False)
    with contextlib.suppress(httpx.HTTPError):
        if client.get("/v1/health/live", timeout=2.0).status_code in (200, 503):
            return client
    client.close()
    return None
