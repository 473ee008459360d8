"""The textbook pipeline, plainly written: what one gets by following the tutorials, to measure ours against.

Full frame, a fixed range of 352 disparities, SGBM with right matcher and WLS, reprojection, then Open3D: voxels, normals, the
floor by RANSAC, clusters by DBSCAN, a plane per cluster, a grasp on the middle of the highest one
that is not too steep. Given a window and range it
runs on those instead (the third row of the table).
"""

import time
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from jaxtyping import Float32

from binpick import geometry
from binpick.data import Image, Window
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.settings import Bin
from binpick.stereo import rectify

DISPARITIES = 352
WALLS_M = 0.015
"""Cut off along the walls: the smoothed map climbs them in ramps."""
STEEP_RAD = 0.6
"""Planes steeper than the tool may tilt are not grasped, as ours are not."""


@dataclass(frozen=True, slots=True, eq=False)
class Textbook:
    """Its answer: grasps best first in the bin's frame, the disparity it used (0 = none), and seconds per step."""

    grasps: list[Transform]
    disparity: Float32[np.ndarray, "h w"]
    window: Window
    seconds: dict[str, float]


def run(left: Image, right: Image, rig: Rig, T_camera_bin: Transform, model: Bin, view: Window | None = None) -> Textbook:
    """One cycle; the images must be the rig's."""
    rect = rectify.rectification(rig)
    width, height = rig.image_size_px
    view = view or Window(0, 0, width, height, 0, DISPARITIES)
    began = time.perf_counter()
    pair = rectify.rectify(left, right, rig, view)
    matched = time.perf_counter()
    matcher = cv2.StereoSGBM.create(0, view.num_disparities, 5, 200, 800, 1, 31, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    raw = matcher.compute(pair.left, pair.right)
    raw_right = cv2.ximgproc.createRightMatcher(matcher).compute(pair.right, pair.left)
    wls = cv2.ximgproc.createDisparityWLSFilter(matcher)
    wls.setLambda(8000)
    wls.setSigmaColor(1.5)
    filtered = wls.filter(raw, pair.left, disparity_map_right=raw_right)[:, pair.margin :]
    disparity = filtered.astype(np.float32) / 16 + view.min_disparity
    disparity[(filtered <= 0) | (raw[:, pair.margin :] < 0)] = 0
    Q = np.array(
        [
            [1, 0, 0, view.x - rect.cx_px],
            [0, 1, 0, view.y - rect.cy_px],
            [0, 0, 0, rect.focal_px],
            [0, 0, 1 / rect.baseline_m, 0],
        ]
    )
    filtered_at = time.perf_counter()
    xyz = cv2.reprojectImageTo3D(disparity, Q)[disparity > 0]
    T_bin_rect = geometry.inverse(T_camera_bin) @ rect.T_camera_rect
    grasps = _grasps(geometry.transform(T_bin_rect, xyz), model)
    ended = time.perf_counter()
    return Textbook(
        grasps,
        disparity,
        view,
        {"rectify": matched - began, "match": filtered_at - matched, "grasp": ended - filtered_at, "total": ended - began},
    )


def _grasps(points: Float32[np.ndarray, "n 3"], model: Bin) -> list[Transform]:
    """Open3D on the whole cloud, then what lies in the bin: one grasp per cluster, highest first."""
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64))).voxel_down_sample(0.002)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.006, 30))
    if len(cloud.points) < 100:
        return []
    length, width, _ = model.inner_size_m
    inside = o3d.geometry.AxisAlignedBoundingBox(
        [-length / 2 + WALLS_M, -width / 2 + WALLS_M, -0.02], [length / 2 - WALLS_M, width / 2 - WALLS_M, 0.5]
    )
    cloud = cloud.crop(inside)
    if len(cloud.points) < 100:
        return []
    _, floor = cloud.segment_plane(0.004, 3, 1000)
    parts = cloud.select_by_index(floor, invert=True)
    labels = np.asarray(parts.cluster_dbscan(0.004, 10))
    grasps = []
    for label in range(int(labels.max(initial=-1)) + 1):
        cluster = parts.select_by_index(np.flatnonzero(labels == label).tolist())
        if len(cluster.points) < 50:
            continue
        plane, inliers = cluster.segment_plane(0.0015, 3, 200)
        normal = np.array(plane[:3]) * (1 if plane[2] > 0 else -1)
        if normal[2] < np.cos(STEEP_RAD):
            continue
        centre = np.asarray(cluster.points)[inliers].mean(axis=0)
        grasps.append(geometry.frame_of_axes(-normal, np.array([1.0, 0, 0]), centre))
    return sorted(grasps, key=lambda T: -T[2, 3])
