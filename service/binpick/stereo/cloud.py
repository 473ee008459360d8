"""Disparity to XYZ: z = f b / d, on the window's pixel grid, in the camera's frame."""

import cv2
import numpy as np

from binpick import geometry
from binpick.data import Depth, OrganisedCloud, Rectified, frozen


def reproject(depth: Depth, rectified: Rectified) -> OrganisedCloud:
    """The organised cloud; sigma_z = z² sigma_d / (f b), the first-order noise of z = f b / d."""
    view = rectified.window
    u = (np.arange(view.width) + (view.x - rectified.cx_px)).astype(np.float32)
    v = (np.arange(view.height) + (view.y - rectified.cy_px)).astype(np.float32)
    depth_scale = np.float32(rectified.focal_px * rectified.baseline_m)
    f = np.float32(rectified.focal_px)
    with np.errstate(divide="ignore"):      # a surface at infinity has the disparity 0
        z = depth_scale / depth.disparity
    rect = cv2.merge([z * (u / f)[None, :], z * (v / f)[:, None], z])
    xyz = geometry.transform(rectified.T_camera_rect, rect)
    sigma_z_m = z * z * depth.sigma_px / depth_scale
    return OrganisedCloud(xyz=frozen(xyz), sigma_z_m=frozen(sigma_z_m), window=view)
