"""The cell's exposure meter: auto exposure by test shots before a cycle's own ones, kept until the light has changed."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from binpick import geometry
from binpick.camera import exposure
from binpick.camera.exposure import Limits, Search
from binpick.cycle import CycleInput
from binpick.data import CameraStatus, Light, StereoPair
from binpick.errors import FrameUnavailable
from binpick.frames import Frames
from binpick.geometry import Transform
from binpick.message import Metering
from binpick.result import Request
from binpick.rig import Rig, RigCamera
from binpick.settings import Job
from binpick.settings.recipe import SHORTEST_US

NEAR_M = 0.05
"""Nearer to a camera its picture of the bin says nothing."""
LEAST_PX = 16
"""A window with fewer pixels along a side cannot be what the cell file means."""
EVERYWHERE = slice(None), slice(None)

log = logging.getLogger(__name__)
Capture = Callable[[Light], StereoPair]


@dataclass(frozen=True, slots=True)
class Settled:
    """What a cycle's shots are exposed with, and what auto exposure came to: the worst outcome of all kinds of light."""

    lights: tuple[Light, ...]
    outcome: Metering


class Meter:
    """Lives on the worker's thread. Shots with the projector and shots without it are metered by themselves.

    Test shots are taken at a cycle's start alone: only then is the robot known to be out of the picture.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._searches: dict[tuple[str, bool], Search] = {}

    def use(self, rig: Rig) -> None:
        """From here on the cameras stand as in this rig."""
        self._rig = rig

    def settle(self, job: Job, request: Request, cameras: Sequence[CameraStatus], capture: Capture) -> Settled:
        """The recipe's lights; metered ones as they were found, by test shots where nothing is known. Raises as `capture`."""
        bases = {light.projector: light for light in reversed(job.recipe.lights) if light.metered}
        limits = _limits(job, cameras)
        found = {on: self._search(job, request, limits, base, capture) for on, base in bases.items()}
        outcomes = sorted((search.outcome for search in found.values()), key=lambda outcome: outcome == "settled")
        lights = tuple(_exposed(light, bases, found, limits) if light.metered else light for light in job.recipe.lights)
        return Settled(lights, outcomes[0] if outcomes else "")

    def watch(self, job: Job, request: Request, lights: Sequence[Light], pairs: Sequence[StereoPair]) -> None:
        """Looks whether the images of a cycle are still as bright as when their exposure was found."""
        seen = {light.projector: pair for light, pair in reversed([*zip(lights, pairs, strict=True)]) if light.metered}
        for projector, pair in seen.items():
            key, wanted = (job.sha256, projector), job.recipe.auto
            level = self._level(job, request, pair)
            if exposure.drifted(self._searches[key], level, wanted):
                log.info("the light has changed (%s): the next cycle sets the exposure again",
                         _told(projector, self._searches[key], level))
                self._searches[key] = _anew(self._searches[key])

    def _search(self, job: Job, request: Request, limits: Limits, base: Light, capture: Capture) -> Search:
        """Each step is kept at once, so that a cycle that is broken off loses none."""
        key = (job.sha256, base.projector)
        search = self._searches.setdefault(key, limits.begin(base.exposure_us))
        if search.outcome:
            return search
        while not search.outcome:
            pair = capture(replace(base, exposure_us=search.exposure_us, gain_db=search.gain_db))
            level = self._level(job, request, pair)
            search = self._searches[key] = exposure.step(search, level, job.recipe.auto, limits)
        told = log.info if search.outcome == "settled" else log.warning
        told("exposure %s after %d test shots: %s", search.outcome, len(search.wished), _told(base.projector, search, level))
        return search

    def _level(self, job: Job, request: Request, pair: StereoPair) -> float:
        try:
            T_camera_bin = Frames.of(CycleInput(0, pair, self._rig, job, request)).T_camera_bin
        except FrameUnavailable:     # before the hand-eye calibration nobody knows where the bin is: samples for it are metered
            images = tuple(frame.image for frame in pair.frames)
        else:
            images = tuple(frame.image[_window(frame.image.shape, camera, T_camera_bin, job.bin.inner_size_m)]
                           for frame, camera in zip(pair.frames, self._rig.cameras, strict=False))
        return exposure.level(images, job.recipe.auto.percentile)


def _limits(job: Job, cameras: Sequence[CameraStatus]) -> Limits:
    """The recipe's, inside of what every camera can do."""
    auto = job.recipe.auto
    ranges = [camera.exposure_range_us for camera in cameras if camera.exposure_range_us]
    shortest_us = max(SHORTEST_US, *(low for low, _ in ranges), 0.0)
    return Limits(shortest_us, max(auto.longest_us, shortest_us), job.recipe.gain_db, auto.highest_gain_db)


def _exposed(light: Light, bases: dict[bool, Light], found: dict[bool, Search], limits: Limits) -> Light:
    """A shorter second exposure stays so many times shorter, as far as the cameras can."""
    search = found[light.projector]
    share = light.exposure_us / bases[light.projector].exposure_us
    return replace(light, exposure_us=max(search.exposure_us * share, limits.shortest_us), gain_db=search.gain_db)


def _anew(search: Search) -> Search:
    """To be gone on with from where it ended."""
    return Search(search.exposure_us, search.gain_db)


def _window(shape: tuple[int, ...], camera: RigCamera, T_camera_bin: Transform, inner_size_m: tuple[float, float, float],
            ) -> tuple[slice, slice]:
    """Rows and columns of an image that show the bin; all of them when the bin is not in it."""
    length, width, height = inner_size_m
    box = geometry.box_corners(np.array([-length / 2, -width / 2, 0.0]), np.array([length / 2, width / 2, height]))
    corners = geometry.transform(camera.T_camera_rig @ T_camera_bin, box)
    if corners[:, 2].min() < NEAR_M:
        return EVERYWHERE
    pixels = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), camera.K_px, camera.distortion_coefficients)[0].reshape(-1, 2)
    (left, top), (right, bottom) = (np.clip(edge, 0, shape[::-1]).astype(int).tolist()
                                    for edge in (pixels.min(axis=0), pixels.max(axis=0)))
    if min(right - left, bottom - top) < LEAST_PX:
        return EVERYWHERE
    return slice(top, bottom), slice(left, right)


def _told(projector: bool, search: Search, level: float) -> str:
    return (f"{'with' if projector else 'without'} the projector {search.exposure_us:.0f} µs, {search.gain_db:.1f} dB, level "
            f"{level:.0f}")
