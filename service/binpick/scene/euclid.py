"""Parts in the unorganised cloud: Open3D's voxels, normals and DBSCAN; the reference to measure the grid route against."""

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Int32
from scipy.spatial import cKDTree

from binpick.data import Labels, Mask
from binpick.scene.surface import Surface
from binpick.settings import SegmentSettings

VOXEL_M = 0.002
NEIGHBOURS = 20
EPS_M = 0.0045
MIN_POINTS = 6


def segment(surface: Surface, of_interest: Mask, settings: SegmentSettings) -> tuple[Labels, Labels]:
    """Faces and parts like `grid.segment`.

    Points on a crease (their normal differs from their neighbours') belong to nobody, so clusters fall apart there; without
    the pixel grid convex and concave creases look alike, therefore faces and parts are the same here.
    """
    labels: Labels = np.zeros(of_interest.shape, dtype=np.int32)
    points = surface.xyz[of_interest].astype(np.float64)
    if len(points) < NEIGHBOURS:
        return labels, labels.copy()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    low, high = cloud.get_min_bound() - VOXEL_M, cloud.get_max_bound() + VOXEL_M
    voxels, _, members = cloud.voxel_down_sample_and_trace(VOXEL_M, low, high)
    voxels.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    smooth = _smooth(voxels, settings.crease_rad)
    found = np.full(len(voxels.points), -1, dtype=np.int32)
    kept = voxels.select_by_index(np.flatnonzero(smooth).tolist())
    found[smooth] = np.asarray(kept.cluster_dbscan(EPS_M, MIN_POINTS), dtype=np.int32)
    labels[of_interest] = _to_points(found, [np.asarray(m) for m in members], len(points))
    return labels, labels.copy()


def _smooth(voxels: o3d.geometry.PointCloud, crease_rad: float) -> Bool[np.ndarray, "n"]:
    """Voxels whose nearest neighbours share their normal within half the crease angle (both sides see the fold)."""
    points, normals = np.asarray(voxels.points), np.asarray(voxels.normals)
    _, neighbours = cKDTree(points).query(points, k=9)
    agree = np.abs(np.einsum("ni,nki->nk", normals, normals[neighbours]))
    smooth: Bool[np.ndarray, "n"] = np.quantile(agree, 0.25, axis=1) > np.cos(crease_rad / 2)
    return smooth


def _to_points(found: Int32[np.ndarray, "n"], members: list[np.ndarray], count: int) -> Int32[np.ndarray, "m"]:
    """Each voxel's cluster on the points it was made of; clusters count from 1."""
    labels = np.zeros(count, dtype=np.int32)
    for cluster, points in zip(found, members, strict=True):
        labels[points] = cluster + 1
    return labels
