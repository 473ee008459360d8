"""Planted boxes: the scene stages find what was put there, and nothing else."""

import cv2
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


def labels_at(segments, *points):
    """The parts around places of the bin, whose surface stands wherever it does."""
    found = []
    for x, y in points:
        here = np.hypot(segments.xyz[..., 0] - x, segments.xyz[..., 1] - y) < 0.004
        labels = np.unique(segments.parts[here])
        assert len(labels[labels > 0]) == 1
        found.append(int(labels[-1]))
    return found


def test_a_thin_plate_on_a_plate_is_a_part(plant, slab):
    segments = segmented(plant([slab(0, 0, 0.12, 0.08, 0.03), slab(0.03, 0, 0.06, 0.08, 0.033)], noise_px=0.07))
    left, right = labels_at(segments, (-0.03, 0), (0.03, 0))
    assert left != right


def test_a_concave_crease_separates_two_parts_and_a_convex_one_two_faces(plant, slab):
    # tops tilted towards or from each other that meet at y = 0
    def faces_meeting(tilt):
        rise = 0.02 * np.tan(abs(tilt))
        top = 0.04 + rise if tilt > 0 else 0.04
        return [slab(0, -0.02, 0.06, 0.04, top, -tilt), slab(0, 0.02, 0.06, 0.04, top, tilt)]

    valley = segmented(plant(faces_meeting(0.35), noise_px=0.07))
    one, other = labels_at(valley, (0, -0.02), (0, 0.02))
    assert one != other
    roof = segmented(plant(faces_meeting(-0.35), noise_px=0.07))
    one, other = labels_at(roof, (0, -0.02), (0, 0.02))
    assert one == other
    faces = [np.unique(roof.faces[np.hypot(roof.xyz[..., 0], roof.xyz[..., 1] - y) < 0.004]) for y in (-0.02, 0.02)]
    assert faces[0][-1] != faces[1][-1]


@pytest.mark.parametrize(("aside", "top", "own"), [(0, 0.06, True), (0.006, 0.06, False), (0, 0.03, False)],
                         ids=["stem", "not flush", "low"])
def test_a_stem_belongs_to_the_bar_it_stands_on_flush(plant, slab, aside, top, own):
    segments = segmented(plant([slab(0, 0, 0.064, 0.016, 0.016), slab(0, aside, 0.016, 0.016, top)], noise_px=0.07))
    left, stem, right = labels_at(segments, (-0.024, 0), (0, aside), (0.024, 0))
    assert (left == stem == right) is own
    assert (len(segments.part_confidence) == 1) is own


@pytest.mark.parametrize(("length", "own"), [(0.04, True), (0.05, False)], ids=["flush", "not flush"])
def test_a_steep_fold_is_within_a_part_where_both_sides_end_flush(plant, slab, length, own):
    flanges = [slab(0, -0.012, 0.04, 0.024, 0.044, -0.75), slab(0, 0.012, length, 0.024, 0.044, 0.75)]
    one, other = labels_at(segmented(plant(flanges, noise_px=0.07)), (0, -0.012), (0, 0.012))
    assert (one == other) is own


@pytest.mark.parametrize(("others", "cut"), [(9, True), (3, False)], ids=["others tell", "too few to tell"])
def test_what_is_longer_than_the_parts_of_its_bin_is_cut_at_its_neck(plant, slab, others, cut):
    around = [slab(0.055 * (i % 5) - 0.11, 0.04 * (i // 5) + 0.01, 0.044, 0.025, 0.02) for i in range(others)]
    pair = [slab(-0.02, -0.05, 0.044, 0.02, 0.02), slab(0.023, -0.062, 0.044, 0.02, 0.02)]
    segments = segmented(plant(around + pair, noise_px=0.07))
    left, right = labels_at(segments, (-0.02, -0.05), (0.023, -0.062))
    assert (left != right) is cut
    assert len(segments.part_confidence) == others + 1 + cut


def test_a_leak_does_not_join_two_parts(plant, slab):
    # two plates of one height, 3 mm apart, bridged by a strip as wide as two pixels
    plates = [slab(-0.0415, 0, 0.08, 0.06, 0.03), slab(0.0415, 0, 0.08, 0.06, 0.03), slab(0, 0, 0.006, 0.0025, 0.03)]
    left, right = labels_at(segmented(plant(plates, noise_px=0.05)), (-0.04, 0), (0.04, 0))
    assert left != right


@pytest.mark.parametrize("method", ["grid", "open3d"])
def test_segments_do_not_depend_on_the_number_of_threads(plant, slab, method):
    boxes = [slab(-0.08, 0, 0.05, 0.04, 0.03), slab(-0.05, 0.02, 0.05, 0.04, 0.045, 0.2), slab(0.08, 0, 0.05, 0.04, 0.015)]
    planted = plant(boxes, noise_px=0.15)
    threads, found = cv2.getNumThreads(), []
    try:
        for number in (1, 2):
            cv2.setNumThreads(number)
            segments = segmented(planted, method)
            found.append((segments.normal.tobytes(), segments.faces.tobytes(), segments.parts.tobytes(),
                          segments.part_confidence))
    finally:
        cv2.setNumThreads(threads)
    assert found[0] == found[1]


def test_what_lies_below_others_is_less_sure_to_be_one_part(plant, slab):
    alone = segmented(plant([slab(0, 0, 0.08, 0.04, 0.02)]))
    below = segmented(plant([slab(0, 0, 0.08, 0.04, 0.02), slab(0, 0.03, 0.10, 0.02, 0.05), slab(0, -0.03, 0.10, 0.02, 0.05)]))
    (sure,), (middle,) = labels_at(alone, (0, 0)), labels_at(below, (0, 0))
    assert below.part_confidence[middle] < 0.85 * alone.part_confidence[sure]


def test_an_empty_bin_has_no_segments(plant):
    segments = segmented(plant([]))
    assert not segments.part_confidence
    assert not segments.parts.any()


def test_what_hides_behind_an_edge_lies_below_the_sight_lines_over_it(job):
    ys, xs = np.mgrid[-0.0995:0.1:0.001, -0.1495:0.15:0.001]
    z = np.where((np.abs(xs) < 0.02) & (np.abs(ys) < 0.02), 0.05, 0.0)
    shadow = (np.abs(ys) < 0.02) & (xs > 0.02) & (xs < 0.032)
    xyz = np.where(shadow[..., None], np.nan, np.stack([xs, ys, z], axis=-1)).astype(np.float32)
    eyes = np.array([[-0.2, 0.0, 0.9], [0.1, 0.0, 0.9]])
    shut, open_ = (heightmap.height_map(xyz, job.bin, at).watertight[50, 85:91] for at in (heightmap.NO_EYES, eyes))
    assert shut[0] == pytest.approx(0.05)
    assert (np.diff(shut) < 0).any()
    assert open_[0] == pytest.approx(0.05), "edges are measured to a cell"
    # the flattest sight line comes over 0.22 m from 0.8 m above the rim
    assert np.diff(open_)[1] == pytest.approx(-0.002 * 0.8 / 0.23, abs=4e-4)


def test_a_pixel_that_stands_out_is_no_obstacle_and_a_thin_wall_is_one(job):
    ys, xs = np.mgrid[-0.0995:0.1:0.001, -0.1495:0.15:0.001]
    z = np.where(np.abs(xs) < 0.002, 0.03, 0.0)
    z[20, 20] = 0.05
    heights = heightmap.height_map(np.stack([xs, ys, z], axis=-1).astype(np.float32), job.bin).height
    assert heights[:20, :20].max() == 0
    assert heights[50, 74:76].min() == pytest.approx(0.03)


def test_a_wall_hides_nothing_from_eyes_inside_and_much_from_eyes_beyond(job):
    ys, xs = np.mgrid[-0.0995:0.1:0.001, -0.1495:0.15:0.001]
    z = np.where(xs > 0.147, 0.10, 0.0)
    hole = (xs > 0.140) & (xs < 0.147) & (np.abs(ys) < 0.03)
    xyz = np.where(hole[..., None], np.nan, np.stack([xs, ys, z], axis=-1)).astype(np.float32)
    inside, beyond = (heightmap.height_map(xyz, job.bin, np.array([[x, 0.0, 0.9]])).watertight[50, 146] for x in (0.0, 0.3))
    assert inside == 0
    assert beyond > 0.085
