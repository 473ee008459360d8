"""Planted boxes: the scene stages find what was put there, and nothing else."""

import numpy as np
import pytest

from binpick import geometry
from binpick.errors import FrameUnavailable
from binpick.scene import bin as load_carrier
from binpick.scene import heightmap, segment
from binpick.scene.surface import surface
from binpick.settings import SegmentSettings
from binpick.stereo import cloud


def seen(planted):
    points = cloud.reproject(planted.depth, planted.rectified)
    xyz_bin = geometry.transform(planted.T_bin_camera, points.xyz)
    return heightmap.height_map(xyz_bin, planted.job.bin), surface(planted.depth, planted.rectified, planted.T_bin_camera)


def filling(planted):
    return load_carrier.filling(seen(planted)[0], planted.job.bin, planted.job.recipe.part)


def segmented(planted, method="grid"):
    _, grid = seen(planted)
    return segment.segment(grid, planted.job.bin, planted.job.recipe.part, SegmentSettings(method=method))


def test_cloud_of_the_floor_lies_on_the_floor(plant):
    planted = plant([])
    points = geometry.transform(planted.T_bin_camera, cloud.reproject(planted.depth, planted.rectified).xyz)
    assert np.abs(points[..., 2]).max() < 1e-5


def test_an_empty_bin_is_proved_empty(plant):
    filled = filling(plant([], noise_px=0.2))
    assert filled.proved_empty
    assert filled.coverage > 0.99


def test_an_empty_looking_bin_with_holes_is_not_proved_empty(plant):
    planted = plant([], unseen=((-0.05, 0, 0.09), (0.08, 0, 0.07)))
    filled = filling(planted)
    assert not filled.occupied
    assert not filled.proved_empty


def test_what_is_not_seen_is_as_high_as_what_surrounds_it(plant, slab):
    planted = plant([slab(0, 0, 0.06, 0.06, 0.05)], unseen=((0.03, 0.0, 0.02),))
    heights, _ = seen(planted)
    assert np.isfinite(heights.watertight).all()
    hole = ~np.isfinite(heights.height)
    assert hole.sum() > 100
    middle = heights.watertight[hole]
    assert np.quantile(middle, 0.1) == pytest.approx(0.05, abs=0.001)


def test_a_part_above_the_rim_overfills(plant, slab):
    planted = plant([slab(0, 0, 0.06, 0.06, 0.12)])
    assert filling(planted).overfilled


def test_mismatches_along_the_wall_neither_fill_nor_overfill(plant, slab):
    planted = plant([slab(-0.148, 0, 0.003, 0.15, 0.13)])
    filled = filling(planted)
    assert not filled.overfilled
    assert not filled.occupied


@pytest.mark.parametrize("tilt", [0.0, 0.3, -0.5])
def test_normals_of_a_tilted_face(plant, slab, tilt):
    planted = plant([slab(0, 0, 0.08, 0.08, 0.05, tilt)], noise_px=0.1)
    _, grid = seen(planted)
    on_face = (np.abs(grid.xyz[..., 0]) < 0.03) & (np.abs(grid.xyz[..., 1]) < 0.03)
    normals = grid.normal[on_face]
    expected = np.array([0, -np.sin(tilt), np.cos(tilt)])
    angle = np.degrees(np.arccos(np.clip(normals @ expected, -1, 1)))
    # 0.1 px of white noise over a 7x7 window of 2x2 means leaves about 1.3 degrees
    assert np.median(angle) < 2.5


@pytest.mark.parametrize("method", ["grid", "open3d"])
def test_separate_boxes_are_separate_parts(plant, slab, method):
    boxes = [slab(-0.08, 0, 0.05, 0.04, 0.03), slab(0.0, 0.03, 0.05, 0.04, 0.05), slab(0.08, -0.03, 0.05, 0.04, 0.015)]
    segments = segmented(plant(boxes, noise_px=0.15), method)
    assert len(segments.part_confidence) == 3
    for box in boxes:
        here = (np.abs(segments.xyz[..., 0] - box.x) < 0.015) & (np.abs(segments.xyz[..., 1] - box.y) < 0.012)
        labels = np.unique(segments.parts[here & np.isfinite(segments.xyz[..., 2])])
        assert len(labels[labels > 0]) == 1


def test_a_step_onto_another_part_is_a_border(plant, slab):
    segments = segmented(plant([slab(0, 0, 0.12, 0.08, 0.03), slab(0.02, 0, 0.04, 0.04, 0.045)], noise_px=0.1))
    assert len(segments.part_confidence) == 2


def test_a_bin_in_the_base_needs_a_hand_eye(job):
    in_base = job.bin.model_copy(update={"pose": job.bin.pose.model_copy(update={"frame": "base"})})
    with pytest.raises(FrameUnavailable, match="hand-eye"):
        load_carrier.place(in_base, None)
    T_base_camera = geometry.translation(1.0, 2.0, 3.0)
    assert np.allclose(load_carrier.place(in_base, T_base_camera), geometry.inverse(T_base_camera) @ in_base.T_parent_bin)
