"""A rig that drifts shows it in its pictures, tags lie where they are said to, and the bench measures against that truth."""

import io
import json

import cv2
import numpy as np
import pytest
from rich.console import Console

from binpick import geometry
from binpick.lab import drift as lab
from binpick.rigcheck import correction, marks, sighting
from binpick.sim import exam
from binpick.sim import marks as tags
from binpick.sim.drift import NONE, Drift
from binpick.sim.world import ScenePart, WorldScene

RIG = exam.rig("A")


def corners_px(number: int, camera: int, drifted: Drift) -> np.ndarray:
    """Where a camera that has drifted sees a tag's corners, from its upper left on."""
    mark, truly = tags.layout("A")[number], drifted.rig(RIG).cameras[camera]
    half = mark.side_m / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    T = truly.T_camera_rig @ geometry.inverse(drifted.T_was_rig) @ exam.setup("A").T_camera_bin @ mark.T_bin_mark
    return cv2.projectPoints(geometry.transform(T, square), np.zeros(3), np.zeros(3), truly.K_px,
                             truly.distortion_coefficients)[0].reshape(4, 2)


@pytest.fixture(scope="module")
def bumped() -> tuple[Drift, lab.Cell]:
    drifted = Drift(yaw_rad=0.002, roll_rad=0.004, shift_m=(0.003, -0.002, 0.004))
    scene = WorldScene("A", (ScenePart(1, "block", geometry.translation(0.05, 0.0, 0.0075)),), 1, 1)
    return drifted, lab.cell("A", scene, lab.light(pattern=False), drifted)


def test_tags_are_seen_where_a_drifted_camera_has_them(bumped: tuple[Drift, lab.Cell]) -> None:
    drifted, at = bumped
    for camera, image in enumerate(at.expose(1)):
        seen = sighting.detect(image, tags.FAMILY)
        assert len(seen) >= 7
        for number, corners in seen.items():
            assert np.abs(corners - corners_px(number, camera, drifted)).max() < 0.2


def test_both_cameras_tell_of_the_drift(bumped: tuple[Drift, lab.Cell]) -> None:
    drifted, at = bumped
    sights = [{mark.number: corners_px(mark.number, camera, NONE).astype(np.float32) for mark in tags.layout("A")}
              for camera in (0, 1)]
    reference = marks.store([(sights[0], sights[1])], RIG, tags.FAMILY)
    seen = marks.compare(reference, [lab.sighting(at.expose(1))], RIG)
    assert np.allclose(seen.shift_m, drifted.shift_m, atol=1e-4)
    assert np.allclose(correction.turned(RIG, seen.rotation_rad).cameras[1].T_camera_rig,
                       drifted.rig(RIG).cameras[1].T_camera_rig, atol=2e-4)


def test_without_tags_the_table_is_bare() -> None:
    points = np.array([[-0.43, 0.06, -0.003], [0.0, 0.3, -0.003]], np.float32)
    bare = np.full(2, 0.3, np.float32)
    assert np.array_equal(tags.painted((), points, bare, 0.0006), bare)
    with_tags = tags.painted(tags.layout("A"), points, bare, 0.0006)
    assert with_tags[0] != bare[0]
    assert with_tags[1] == bare[1]


def test_what_a_turned_camera_does_to_depth() -> None:
    corners = {0: (((-0.1, -0.1, 1.0), (0.1, -0.1, 1.0), (0.1, 0.1, 1.0), (-0.1, 0.1, 1.0)))}
    reference = marks.Reference.model_construct(family=tags.FAMILY, marks=corners, rig_sha256="")
    off_m = lab.true_depth_error(RIG, Drift(yaw_rad=0.0002), reference)
    assert off_m == pytest.approx(-0.0002 / 0.15, rel=0.05)
    assert abs(lab.true_depth_error(RIG, NONE, reference)) < 1e-12


def test_trials_are_of_the_sizes_that_their_names_say() -> None:
    named = {trial.name: trial for trial in lab.trials("B")}
    assert named["pitch 3 px"].drifted.pitch_rad * exam.setup("B").right.focal_px[1] == pytest.approx(3.0)
    for mm in (1, 2, 5):
        assert 1000 * np.linalg.norm(named[f"mount {mm} mm"].drifted.shift_m) == pytest.approx(mm, abs=0.01)
    assert named["yaw 0.05 deg"].by_marks


def test_a_run_is_json_and_tables() -> None:
    errors = {"depth_error_mm": 0.25, "measured": 0.9}
    told = {"trial": "pitch 3 px", "world": "A", "seed": 1, "pattern": True, "level": "fault", "warned_after": 5,
            "fault_after": 5, "row_px": 3.1, "off_px": 3.1, "pitch_px": 3.003, "true_pitch_px": 3.0, "undrifted": errors,
            "uncorrected": {"depth_error_mm": None, "measured": 0.0}, "by_rows": errors, "by_marks": errors}
    still = {"world": "A", "seeds": [1], "pattern": True, "cycles": 500, "warnings": 0, "largest_row_px": 0.05,
             "largest_depth_mm": 0.1, "largest_shift_mm": 0.1}
    run = {"exam_sha256": exam.sha256(), "trials": [told], "calm": [still]}
    assert json.loads(json.dumps(run)) == run
    console = Console(width=170, file=io.StringIO())
    console.print(*lab.tables(run))
    text = console.file.getvalue()
    assert "3.003, 3" in text
    assert "0.250, -, 0.250, 0.250" in text
    assert "500" in text


@pytest.mark.slow
def test_a_turned_camera_is_noticed_told_and_corrected() -> None:
    chosen = [trial for trial in lab.trials("A") if trial.name in ("pitch 1.1 px", "yaw 0.02 deg")]
    pitched, yawed = lab.sit("A", 1, lab.light(pattern=True), chosen)
    assert pitched["level"] == "fault"
    assert pitched["pitch_px"] == pytest.approx(1.1, abs=0.05)
    assert yawed["level"] == "warn"
    assert yawed["depth_mm"] == pytest.approx(yawed["true_depth_mm"], abs=0.5)
    for row, way in ((pitched, "by_rows"), (pitched, "by_marks"), (yawed, "by_marks")):
        assert row[way]["depth_error_mm"] < 1.1 * row["undrifted"]["depth_error_mm"] < row["uncorrected"]["depth_error_mm"]
