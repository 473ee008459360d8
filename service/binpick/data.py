"""The frozen values that flow from stage to stage; arrays carry shape and dtype, NaN means not measured."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from binpick.geometry import Transform

Image: TypeAlias = UInt8[np.ndarray, "h w"]
Disparity: TypeAlias = Float32[np.ndarray, "h w"]
Cloud: TypeAlias = Float32[np.ndarray, "h w 3"]
Mask: TypeAlias = Bool[np.ndarray, "h w"]
Labels: TypeAlias = Int32[np.ndarray, "h w"]

# A programmable projector's sequence, by Light.pattern: random dots 0 to 7, then OpenCV's Gray code of a picture this wide and
# high (structured_light.GrayCodePattern: columns, then rows, each image followed by its inverse), then all white, all black.
DOT_PATTERNS = 8
GRAY_CODE_SIZE_PX = (1024, 768)
GRAY_CODE_IMAGES = 40
FIRST_GRAY_PATTERN = DOT_PATTERNS
WHITE_PATTERN = FIRST_GRAY_PATTERN + GRAY_CODE_IMAGES
BLACK_PATTERN = WHITE_PATTERN + 1


def frozen(array: np.ndarray) -> np.ndarray:
    """The same array, read-only from here on: stages hand over values, not workspaces."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """What a shot is exposed with; `pattern` is the place in a programmable projector's sequence, 0: the random dots.

    `metered`: exposure and gain are only where auto exposure begins.
    """

    exposure_us: float
    gain_db: float
    projector: bool
    pattern: int = 0
    metered: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of one camera, with the facts that prove which instant it shows.

    `timestamp_ns` is the start of exposure in the device's own clock; `triggered_ns` and `received_ns` are the host's
    monotonic clock. `sequence` is the group's trigger counter, `frame_id` the camera's own. When the exposure began by the
    host's clock: between `triggered_ns` and `acknowledged_ns` (0: nothing says so), and between the two of `latched_ns` by the
    device's clock as it was compared (None: it was not). `ptp` is "Master" or "Slave" while that clock keeps together with
    others, and `ptp_offset_ns` its distance from the master's.
    """

    image: Image
    camera: str
    sequence: int
    frame_id: int
    timestamp_ns: int
    triggered_ns: int
    received_ns: int
    exposure_us: float
    gain_db: float
    resends: int = 0
    missing: int = 0
    acknowledged_ns: int = 0
    latched_ns: tuple[int, int] | None = None
    ptp: str = ""
    ptp_offset_ns: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """Two frames of one trigger, and those of a third camera and on; captured_at is ISO 8601 UTC wall time.

    `skew_us` is of the two that may be furthest apart; `proof` names what it rests on: ptp, latch (device clocks compared with
    the host's), interval (the host's times alone), none.
    """

    left: Frame
    right: Frame
    captured_at: str
    skew_us: float
    sigma_us: float
    proof: str
    more: tuple[Frame, ...] = ()

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Of all cameras, in the rig's order."""
        return self.left, self.right, *self.more

    @property
    def arrival_ms(self) -> float:
        """From the first trigger until all images were there."""
        return (max(frame.received_ns for frame in self.frames) - min(frame.triggered_ns for frame in self.frames)) / 1e6


@dataclass(frozen=True, slots=True)
class CameraStatus:
    """What a camera says of itself; `error` is empty when it is well.

    `ptp` is the camera's PtpStatus ("": it has none), `ptp_offset_us` its distance from the master, to 0.1 µs; `refused` the
    pairs refused since the start, of all cameras together. The ranges are the camera's own, null while they are not known.
    """

    name: str
    connected: bool
    model: str = ""
    serial: str = ""
    address: str = ""
    frames: int = 0
    failures: int = 0
    resends: int = 0
    error: str = ""
    simulated: bool = False
    ptp: str = ""
    ptp_offset_us: float = 0.0
    packet_size: int = 0
    refused: int = 0
    exposure_range_us: tuple[float, float] | None = None
    gain_range_db: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Window:
    """The pixels of the rectified left view that can show the bin's box, and the disparities it can have."""

    x: int
    y: int
    width: int
    height: int
    min_disparity: int
    num_disparities: int


@dataclass(frozen=True, slots=True, eq=False)
class Rectified:
    """The window of both views on common rows; in `right` a point stands disparity − min_disparity px further left.

    Both images carry `margin` more columns on the left than the window, so that every window pixel has its whole search
    range. `focal_px`, `baseline_m` and the principal point belong to the rectified left view, its pixel (0, 0) being the
    whole view's; T_camera_rect turns rect directions into the camera frame.
    """

    left: Image
    right: Image
    window: Window
    margin: int
    focal_px: float
    baseline_m: float
    cx_px: float
    cy_px: float
    T_camera_rect: Transform


@dataclass(frozen=True, slots=True, eq=False)
class Depth:
    """Disparity of the window's pixels in px, absolute. `measured` gates it: elsewhere `disparity` is NaN.

    `fill` makes the smoothed map for people, which is never a grasp's evidence: no cycle waits for it. `sigma_px` is each
    measured pixel's 1-sigma noise, NaN elsewhere.
    """

    disparity: Disparity
    fill: Callable[[], Disparity]
    confidence: UInt8[np.ndarray, "h w"]
    measured: Mask
    sigma_px: Disparity

    @property
    def filled(self) -> Disparity:
        """The map for people, px, absolute everywhere; made anew each time."""
        return frozen(self.fill())


@dataclass(frozen=True, slots=True, eq=False)
class OrganisedCloud:
    """XYZ on the window's pixel grid, frame `camera`, metres, NaN = not measured; sigma_z_m travels with it."""

    xyz: Cloud
    sigma_z_m: Float32[np.ndarray, "h w"]
    window: Window


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Heights above the bin's floor on a square grid over the bin's inside, frame `bin`, metres.

    `height` is NaN where nothing was measured; `watertight` has no holes: unseen cells hold the highest thing that could hide
    them. Cell (i, j) covers x from origin_x_m + j * cell_m and y from origin_y_m + i * cell_m.
    """

    height: Float32[np.ndarray, "rows cols"]
    watertight: Float32[np.ndarray, "rows cols"]
    cell_m: float
    origin_x_m: float
    origin_y_m: float
    coverage: float


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Faces (for suction) and parts (ownership) on the same grid as `xyz`; label 0 is nobody.

    `xyz` and `normal` are frame `bin`, `normal` points away from the surface towards the camera. `part_points` are
    the points of each part, `part_confidence` how sure it is that they are one part.
    """

    xyz: Cloud
    normal: Cloud
    faces: Labels
    parts: Labels
    part_points: dict[int, Float32[np.ndarray, "n 3"]]
    part_confidence: dict[int, float]


@dataclass(frozen=True, slots=True, eq=False)
class PartPose:
    """What some segments were found to be: a part of the recipe's mesh at `T_bin_part`, or None when that is not sure.

    `part_ids` are the labels of the segments, the one that was looked at first; `score` is 0 to 1.
    """

    part_ids: tuple[int, ...]
    T_bin_part: Transform | None
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """A candidate while it is being judged; T_bin_tcp as in a published pose, z into the object.

    `seal_m` is how far the lip must bend to follow the surface; `room` the share of the lip around which the part goes on.
    `doubt` is what speaks against two fingers' hold, 0 to 1. `open_m` and `close_m` are 0 for suction.
    """

    T_bin_tcp: Transform
    tool: int
    part_id: int
    open_m: float
    close_m: float
    quality: float
    seal_m: float
    room: float
    sigma_xy_m: float
    sigma_z_m: float
    sigma_tilt_rad: float
    clearance_m: float = float("nan")
    doubt: float = 0.0
