"""Spoiled sets made of real images: the culprit is named, and the rig stays what the clean set gives."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from binpick.errors import InputError
from binpick.rig import Rig
from binpick.rigcheck import board as boards
from binpick.rigcheck import sight
from binpick.rigcheck.detection import Detection
from binpick_calib import solve, views

DATA = Path(__file__).parents[2] / "../shared/data"
SETS = {"opencv": (DATA / "opencv_samples", "left*.jpg", "right*.jpg", "chessboard:9x6:0.025"),
        "titania": (DATA / "i3dr_titania/checker_sample", "*_l.png", "*_r.png", "chessboard:10x6:0.025")}
Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Clean:
    """One real set: its images, what was seen in them, and the rig they give."""

    board: boards.Board
    images: list[Pair]
    seen: views.Views
    rig: Rig

    def spoiled(self, changes: dict[int, Pair]) -> views.Views:
        """The views with some of the images replaced, looked at anew."""
        anew = list(self.seen.used)
        for place, pair in changes.items():
            found = [sight.find(image, self.board) for image in pair]
            numbered = sight.align(found[0], found[1])
            assert isinstance(numbered, Detection)
            shot = views.Shot(anew[place].number, tuple(Path(name) for name in anew[place].names))
            anew[place] = views.view(shot, self.board, (found[0], numbered))
        kept, rejected = views.screen(anew)
        return views.Views(self.seen.image_size_px, kept, rejected)


@pytest.fixture(scope="module", params=["opencv", pytest.param("titania", marks=pytest.mark.slow)])
def clean(request: pytest.FixtureRequest) -> Clean:
    folder, left, right, spec = SETS[request.param]
    if not folder.is_dir():
        pytest.skip("the real stereo samples are not here")
    board = boards.parse(spec)
    shots, _ = views.match(str(folder / left), str(folder / right))
    images = [tuple(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in shot.files) for shot in shots]
    seen = views.detect(shots, board)
    return Clean(board, images, seen, solve.solve(seen, board, "2026-01-01").rig)


def shifted(image: np.ndarray, right_px: float, down_px: float) -> np.ndarray:
    return cv2.warpAffine(image, np.array([[1.0, 0, right_px], [0, 1, down_px]]), None, borderMode=cv2.BORDER_REPLICATE)


def mirrored(pair: Pair) -> Pair:
    return tuple(np.ascontiguousarray(image[:, ::-1]) for image in pair)


def baseline_m(rig: Rig) -> float:
    return float(np.linalg.norm(rig.cameras[1].T_camera_rig[:3, 3]))


EVERY_OTHER = range(0, 13, 2)
SPOILS: dict[str, tuple[Callable[[list[Pair]], dict[int, Pair]], str]] = {
    "one partner swapped": (lambda i: {3: (i[3][0], i[7][1])}, "wrong partner: its second image belongs to the first"),
    "two partners exchanged": (lambda i: {3: (i[3][0], i[7][1]), 7: (i[7][0], i[3][1])}, "wrong partner"),
    "board shifted by 3 px": (lambda i: {5: (i[5][0], shifted(i[5][1], 3, 0))}, "the board moved between the two images"),
    "board shifted by 2 px down": (lambda i: {2: (shifted(i[2][0], 0, 2), i[2][1])}, "the board moved between the two images"),
    "one view blurred": (lambda i: {6: (cv2.GaussianBlur(i[6][0], None, 2), i[6][1])}, "blurred"),
    "one view moved while exposed": (lambda i: {6: (i[6][0], cv2.blur(i[6][1], (9, 1)))}, "blurred"),
    "half of the sides exchanged": (lambda i: {n: (i[n][1], i[n][0]) for n in range(6)}, "left and right are exchanged"),
    "more than half exchanged": (lambda i: {n: (i[n][1], i[n][0]) for n in EVERY_OTHER}, "left and right are exchanged"),
    "half mirrored": (lambda i: {n: mirrored(i[n]) for n in range(6)}, "both images of this view are mirrored"),
    "more than half mirrored": (lambda i: {n: mirrored(i[n]) for n in EVERY_OTHER}, "both images of this view are mirrored"),
}


@pytest.mark.parametrize("spoil", SPOILS)
def test_the_culprit_is_named_and_does_no_harm(clean: Clean, spoil: str) -> None:
    change, reason = SPOILS[spoil]
    changes = change(clean.images)
    solution = solve.solve(clean.spoiled(changes), clean.board, "2026-01-01")
    rejected = solution.quality.rejected
    for place in changes:
        names = clean.seen.used[place].names
        told = [why for files, why in rejected.items() if any(name in files for name in names)]
        assert told
        assert told[0].startswith(reason), told
    assert len(rejected) == len(changes), "nobody else is blamed"
    assert len(solution.per_view_px) == 13 - len(changes)
    for ours, theirs in zip(solution.rig.cameras, clean.rig.cameras, strict=True):
        assert ours.K_px == pytest.approx(theirs.K_px, rel=0.02)
    assert baseline_m(solution.rig) == pytest.approx(baseline_m(clean.rig), rel=0.02)


def test_sides_given_the_wrong_way_round(clean: Clean) -> None:
    turned = [replace(view, corners_px=view.corners_px[::-1]) for view in clean.seen.used]
    with pytest.raises(InputError, match="13 of 13 views the right camera stands to the left of the left one: exchange --left"):
        solve.solve(replace(clean.seen, used=tuple(turned)), clean.board, "2026-01-01")


def test_every_partner_wrong_is_refused(clean: Clean) -> None:
    lefts, rights = zip(*clean.images, strict=True)
    mixed = {place: (left, right) for place, (left, right) in enumerate(zip(lefts, rights[1:] + rights[:1], strict=True))}
    with pytest.raises(InputError, match=r"no consistent solution: only .* disagree: .*wrong partner"):
        solve.solve(clean.spoiled(mixed), clean.board, "2026-01-01")


def test_a_camera_bumped_half_way_is_refused(clean: Clean) -> None:
    used = [replace(view, corners_px=(view.corners_px[0], view.corners_px[1] + np.float32([0, 9 if n >= 9 else 0])))
            for n, view in enumerate(clean.seen.used)]
    later = ", ".join(str(view.number) for view in used[9:])
    with pytest.raises(InputError, match=f"and views {later} agree on another step: a camera was moved in between"):
        solve.solve(replace(clean.seen, used=tuple(used)), clean.board, "2026-01-01")
