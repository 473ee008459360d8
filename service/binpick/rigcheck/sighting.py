"""A sighting: the tags in one image, their corners where the straight sides meet, also under a projected pattern."""

from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Float, Float32

from binpick.data import Image
from binpick.errors import InputError

Corners: TypeAlias = Float32[np.ndarray, "4 2"]
_Sides: TypeAlias = Float[np.ndarray, "n 2"]
WINDOWS = (31, 71)
"""Neighbourhoods of the threshold, px of half size: as large as a tag, so that its modules and dots on it stay one thing."""
ALONG = (0.08, 0.92)
"""The part of a side that is looked at: its ends are round in any lens."""
SAMPLES = 48
"""Profiles across each side."""
ACROSS = 0.7
"""Modules that a profile goes to each side of the edge at first: a tag's border is one module of black, its margin at least one
of white."""
NEAR_PX = (3.0, 2.0, 2.0)
"""Then: dots of a pattern on the white would draw the edge outwards."""
STEP_PX = 0.5


def detect(image: Image, family: str) -> dict[int, Corners]:
    """Corners of each tag of a family ("apriltag_36h11", "4x4_50", ...) in an image as taken, px, from its upper left on.

    Raises InputError for a family that there is not.
    """
    dictionary, bits = _dictionary(family)
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = WINDOWS
    parameters.adaptiveThreshWinSizeStep = WINDOWS[1] - WINDOWS[0]
    # a bit is read from the middle of its module, averaged over what dots do to it
    parameters.perspectiveRemovePixelPerCell, parameters.perspectiveRemoveIgnoredMarginPerCell = 8, 0.2
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(half)
    if ids is None:
        return {}
    # the middle of a pixel of half size lies between two of full size
    rough = {int(number): 2 * corners[0].astype(float) + 0.5 for number, corners in zip(ids.ravel(), found, strict=True)}
    return {number: _refined(image, rough[number], bits).astype(np.float32) for number in sorted(rough)}


def _dictionary(family: str) -> tuple[cv2.aruco.Dictionary, int]:
    """The family's tags, and how many modules they have each way, border included."""
    name = f"DICT_{family.upper()}"
    if not hasattr(cv2.aruco, name):
        known = sorted({given.removeprefix("DICT_").lower() for given in dir(cv2.aruco) if given.startswith("DICT_")})
        raise InputError(f"there is no family of tags {family!r}; there are {', '.join(known)}")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    return dictionary, dictionary.markerSize + 2


def _refined(image: Image, corners: Float[np.ndarray, "4 2"], modules: int) -> Float[np.ndarray, "4 2"]:
    """Where lines through the sides' edges meet, looked for ever nearer."""
    side_px = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    for reach_px in (ACROSS * side_px / modules, *NEAR_PX):
        lines = [_line(edges) for edges in _edges(image, corners, reach_px)]
        meets = np.array([np.cross(lines[side - 1], lines[side]) for side in range(4)])
        corners = meets[:, :2] / meets[:, 2:]
    return corners


def _edges(image: Image, corners: Float[np.ndarray, "4 2"], reach_px: float) -> Float[np.ndarray, "4 n 2"]:
    """Places on each side's edge, from black inside to white outside: the middle of the rise along profiles square to it."""
    following = np.roll(corners, -1, axis=0)
    along = following - corners
    length = np.linalg.norm(along, axis=1, keepdims=True)
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / length
    outward *= np.sign(((corners + following) / 2 - corners.mean(0)) @ outward.T).diagonal()[:, None]
    offsets = np.arange(-reach_px, reach_px + STEP_PX / 2, STEP_PX)
    start = corners[:, None] + np.linspace(*ALONG, SAMPLES)[:, None] * along[:, None]
    at = (start[:, :, None] + offsets[:, None] * outward[:, None, None]).astype(np.float32).reshape(4 * SAMPLES, -1, 2)
    values = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    rise = np.maximum(np.diff(values, axis=1), 0)
    middles = (offsets[1:] + offsets[:-1]) / 2
    edge = (rise @ middles) / np.maximum(rise.sum(axis=1), 1e-9)
    edges: Float[np.ndarray, "4 n 2"] = start + edge.reshape(4, SAMPLES, 1) * outward[:, None]
    return edges


def _line(points: _Sides) -> Float[np.ndarray, "3"]:
    """The homogeneous line through points, few of which may lie off it."""
    vx, vy, x, y = cv2.fitLine(points.astype(np.float32), cv2.DIST_HUBER, 0, 1e-3, 1e-3).ravel().astype(float)
    return np.array([-vy, vx, vy * x - vx * y])
