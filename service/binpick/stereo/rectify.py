"""Rectifies only what can show the bin: its box gives the window and the disparity range, so nobody types them."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int16, UInt16

from binpick import geometry
from binpick.data import Image, Rectified, Window, frozen
from binpick.errors import ImageError, RigError
from binpick.geometry import Transform, Vector
from binpick.rig import Rig

RANGE_MARGIN_PX = 3
"""Disparities searched beyond the box's own: calibration and bin pose are not exact."""
EDGE_MARGIN_PX = 8
"""Pixels around the box: a block at its edge needs neighbours."""


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """Both views turned onto common rows: one camera matrix, a baseline along x.

    `T_camera_rect` turns rect directions into the first camera's; `R_right_rect` into the second's.
    """

    focal_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    T_camera_rect: Transform
    R_right_rect: Float[np.ndarray, "3 3"]


def rectification(rig: Rig) -> Rectification:
    """The rectifying rotations of the rig's first two cameras (Bouguet's, by OpenCV). Raises RigError.

    The focal length is the mean of the two cameras', so that pixels keep their size.
    """
    left, right = rig.cameras[0], rig.cameras[1]
    T_right_left = right.T_camera_rig
    R1, R2, _, P2, *_ = cv2.stereoRectify(left.K_px, left.distortion_coefficients, right.K_px, right.distortion_coefficients,
                                          rig.image_size_px, T_right_left[:3, :3], T_right_left[:3, 3],
                                          flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1)
    if abs(P2[1, 3]) > abs(P2[0, 3]):
        raise RigError("the second camera sits above or below the first: mount them side by side, or swap rows and columns")
    baseline_m = -float(P2[0, 3] / P2[0, 0])
    if baseline_m <= 0:
        raise RigError("the second camera sits to the left of the first: swap the two cameras in the rig and the cell file")
    K = (left.K_px + right.K_px) / 2
    return Rectification(
        focal_px=float(K[0, 0] + K[1, 1]) / 2, cx_px=float(K[0, 2]), cy_px=float(K[1, 2]), baseline_m=baseline_m,
        T_camera_rect=geometry.make(R1.T, np.zeros(3)), R_right_rect=np.asarray(R2.T, dtype=float))


def window(rect: Rectification, T_camera_bin: Transform, low_m: Vector, high_m: Vector) -> Window:
    """The window and disparity range of a box given in the bin's frame.

    Raises RigError when the box reaches behind the cameras: then the bin's pose is wrong.
    """
    corners = geometry.transform(geometry.inverse(rect.T_camera_rect) @ T_camera_bin, geometry.box_corners(low_m, high_m))
    if corners[:, 2].min() < 0.05:
        raise RigError("the bin's pose puts it at or behind the cameras: check the bin's pose and its frame in the cell file")
    u = rect.focal_px * corners[:, 0] / corners[:, 2] + rect.cx_px
    v = rect.focal_px * corners[:, 1] / corners[:, 2] + rect.cy_px
    disparity = rect.focal_px * rect.baseline_m / corners[:, 2]
    nearest, farthest = float(disparity.max()) + RANGE_MARGIN_PX, float(disparity.min()) - RANGE_MARGIN_PX
    low = max(0, int(np.floor(farthest)))
    x, y = int(np.floor(u.min())) - EDGE_MARGIN_PX, int(np.floor(v.min())) - EDGE_MARGIN_PX
    return Window(x=x, y=y, width=int(np.ceil(u.max())) + EDGE_MARGIN_PX - x, height=int(np.ceil(v.max())) + EDGE_MARGIN_PX - y,
                  min_disparity=low, num_disparities=16 * int(np.ceil((nearest - low) / 16)))


def visible(rect: Rectification, rig: Rig, view: Window) -> Window:
    """The part of a window that the left camera sees at all; the rest would only be black."""
    K, distortion = rig.cameras[0].K_px, rig.cameras[0].distortion_coefficients
    width, height = rig.image_size_px
    across, down = np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33)
    border = np.concatenate([np.stack(np.meshgrid(across, [0, height - 1]), -1).reshape(-1, 2),
                             np.stack(np.meshgrid([0, width - 1], down), -1).reshape(-1, 2)])
    P = np.array([[rect.focal_px, 0, rect.cx_px], [0, rect.focal_px, rect.cy_px], [0, 0, 1]])
    seen = cv2.undistortPoints(border.reshape(-1, 1, 2), K, distortion, R=rect.T_camera_rect[:3, :3].T, P=P).reshape(-1, 2)
    x0, y0 = max(view.x, int(seen[:, 0].min())), max(view.y, int(seen[:, 1].min()))
    x1 = min(view.x + view.width, int(seen[:, 0].max()) + 1)
    y1 = min(view.y + view.height, int(seen[:, 1].max()) + 1)
    if x1 - x0 < 32 or y1 - y0 < 32:
        raise RigError("the bin lies outside the left camera's view: check the bin's pose in the cell file")
    return Window(x0, y0, x1 - x0, y1 - y0, view.min_disparity, view.num_disparities)


def rectify(left: Image, right: Image, rig: Rig, view: Window) -> Rectified:
    """Both images on the window's grid, one remap each. Raises ImageError on images of another size than the rig."""
    expected = (rig.image_size_px[1], rig.image_size_px[0])
    for name, image in (("left", left), ("right", right)):
        if image.shape != expected:
            raise ImageError(f"the {name} image is {image.shape[1]}x{image.shape[0]} px, but the rig was calibrated at "
                             f"{expected[1]}x{expected[0]}: use the rig file of these cameras, and no cropping or binning")
    maps = _maps(rig.sha256, rig, view)
    rect = rectification(rig)
    images = [frozen(cv2.remap(image, *pair, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0))
              for image, pair in zip((left, right), maps, strict=True)]
    return Rectified(left=images[0], right=images[1], window=view, margin=view.num_disparities, focal_px=rect.focal_px,
                     baseline_m=rect.baseline_m, cx_px=rect.cx_px, cy_px=rect.cy_px, T_camera_rect=rect.T_camera_rect)


def whole(left: Image, right: Image, min_disparity: int, num_disparities: int) -> Rectified:
    """Images that are rectified already, whole; their left margin is the border repeated, which matches nothing.

    `num_disparities` is rounded up to the 16 that OpenCV wants. Nothing is known of the cameras:
    focal length and baseline are 1. Raises ImageError on images of two sizes.
    """
    if left.shape != right.shape:
        raise ImageError(f"the left image is {left.shape[1]}x{left.shape[0]} px, the right {right.shape[1]}x{right.shape[0]}")
    rows, cols = left.shape
    wanted = 16 * ((num_disparities + 15) // 16)
    view = Window(0, 0, cols, rows, min_disparity, wanted)
    padded = [frozen(cv2.copyMakeBorder(image, 0, 0, wanted + shift, 0, cv2.BORDER_REPLICATE)[:, :cols + wanted])
              for image, shift in ((left, 0), (right, min_disparity))]
    return Rectified(left=padded[0], right=padded[1], window=view, margin=wanted, focal_px=1.0, baseline_m=1.0, cx_px=0.0,
                     cy_px=0.0, T_camera_rect=np.eye(4))


Map = tuple[Int16[np.ndarray, "h w 2"], UInt16[np.ndarray, "h w"]]


@functools.lru_cache(maxsize=8)
def _maps_of(key: "_Key") -> tuple[Map, Map]:
    rect, view, rig = rectification(key.rig), key.view, key.rig
    size = (view.width + view.num_disparities, view.height)
    maps = []
    for camera, R_cam_rect, shift in ((rig.cameras[0], rect.T_camera_rect[:3, :3], 0),
                                      (rig.cameras[1], rect.R_right_rect, view.min_disparity)):
        P = np.array([[rect.focal_px, 0, rect.cx_px - (view.x - view.num_disparities - shift)],
                      [0, rect.focal_px, rect.cy_px - view.y], [0, 0, 1]])
        pair = cv2.initUndistortRectifyMap(camera.K_px, camera.distortion_coefficients, R_cam_rect.T, P, size, cv2.CV_16SC2)
        maps.append((np.asarray(pair[0], dtype=np.int16), np.asarray(pair[1], dtype=np.uint16)))
    return maps[0], maps[1]


class _Key:
    """A rig and a window, equal when their content is: the maps cost 100 ms and depend on nothing else."""

    def __init__(self, sha256: str, rig: Rig, view: Window) -> None:
        self.sha256, self.rig, self.view = sha256, rig, view

    def __hash__(self) -> int:
        return hash((self.sha256, self.view))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and (self.sha256, self.view) == (other.sha256, other.view)


def _maps(sha256: str, rig: Rig, view: Window) -> tuple[Map, Map]:
    return _maps_of(_Key(sha256, rig, view))
