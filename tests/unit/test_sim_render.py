"""Pictures obey optics: the same shot twice is the same, light adds up, both cameras see one world."""

import hashlib

import cv2
import numpy as np
import pytest

from binpick import geometry
from binpick.data import BLACK_PATTERN, WHITE_PATTERN, Light, Window
from binpick.errors import InputError
from binpick.sim import exam
from binpick.sim.mesh import Caster
from binpick.sim.render import Renderer
from binpick.sim.truth import truth
from binpick.sim.world import ScenePart, WorldScene

PATTERN, PLAIN = Light(6000.0, 0.0, True), Light(6000.0, 0.0, False)


@pytest.fixture(scope="module")
def scene():
    turned = geometry.frame_of_axes(np.array([0.1, 0.2, 1.0]), np.array([1.0, 1.0, 0.0]), np.array([0.03, 0.02, 0.03]))
    flat = geometry.translation(-0.12, -0.05, 0.008)
    return WorldScene("A", (ScenePart(1, "block", turned), ScenePart(2, "tee", flat)), 5, 1)


@pytest.fixture(scope="module")
def renderer():
    return Renderer(exam.rig("A"), "A")


def test_a_shot_is_reproducible_and_no_two_are_alike(renderer, scene):
    first = renderer.expose(scene, 0, PATTERN, 7)
    assert first.shape == (1216, 1936)
    assert np.array_equal(first, renderer.expose(scene, 0, PATTERN, 7))
    other = renderer.expose(scene, 0, PATTERN, 8)
    assert not np.array_equal(first, other)
    assert abs(float(first.mean()) - float(other.mean())) < 0.1


def test_pictures_stay_as_they_are_byte_by_byte(renderer, scene):
    """Tables that were measured on them stay comparable; a change needs a line in DECISIONS and every baseline run anew."""
    pictures = {(index, light.projector): hashlib.sha256(renderer.expose(scene, index, light, 7).tobytes()).hexdigest()[:16]
                for index in (0, 1) for light in (PATTERN, PLAIN)}
    assert pictures == {(0, True): "423c72155dba629c", (0, False): "1241626d25336b8b",
                        (1, True): "c897c28768e421f2", (1, False): "5994df34bb432051"}


def test_a_programmable_projector_throws_what_the_light_names(renderer, scene):
    def mean(pattern, rows=slice(500, 700), columns=slice(800, 1100)):
        return renderer.radiance(scene, 0, pattern)[rows, columns].mean()

    off, black, white = mean(None), mean(BLACK_PATTERN), mean(WHITE_PATTERN)
    assert black == pytest.approx(off, rel=1e-5)
    assert white > 2 * off
    # the dots are this share of full light on average, whatever their seed
    shares = [(mean(pattern) - off) / (white - off) for pattern in (0, 3)]
    assert shares[1] == pytest.approx(shares[0], rel=0.02)
    pictures = [renderer.radiance(scene, 0, pattern)[500:700, 800:1100] for pattern in (0, 3, None, WHITE_PATTERN)]
    lit = pictures[3] > 1.5 * pictures[2]
    dots, others = ((picture / pictures[3])[lit] for picture in pictures[:2])
    assert abs(np.corrcoef(dots, others)[0, 1]) < 0.1
    with pytest.raises(InputError, match=f"0 to {BLACK_PATTERN}"):
        renderer.expose(scene, 0, Light(6000.0, 0.0, True, BLACK_PATTERN + 1), 1)


def test_around_the_bin_lies_the_same_light(renderer, scene):
    renderer.radiance(scene, 0, WHITE_PATTERN)
    for pattern, picture in renderer._views[0].empty.items():
        assert np.array_equal(renderer._surround(0, pattern), picture)


@pytest.mark.slow
@pytest.mark.parametrize("world", ["A", "B"])
def test_no_part_is_seen_outside_its_silhouette(world):
    kinds = exam.MIXTURES["mixed"]
    length, width, height = exam.setup(world).bin_size_m
    turned = [geometry.frame_of_axes(np.array([0.3, np.sin(i), np.cos(i)]), np.array([1.0, 1.0, 0.0]),
                                     np.array([(i % 3 - 1) * length * 0.4, (i % 2 - 0.5) * width * 0.8, height - 0.03 * i]))
              for i in range(len(kinds))]
    scene = WorldScene(world, tuple(ScenePart(i, k, T) for i, (k, T) in enumerate(zip(kinds, turned, strict=True), 1)), 1, 1)
    renderer = Renderer(exam.rig(world), world)
    for index in (0, 1):
        renderer.radiance(scene, index, None)
        view = renderer._views[index]
        shown = np.flatnonzero(Caster(scene).cast(view.rays).part_id > 0)
        assert len(shown) > 10_000
        assert np.isin(shown, renderer._silhouettes(scene, index, view.crop)).all()


def test_a_shot_draws_nothing_anew(renderer, scene):
    assert renderer.radiance(scene, 0, 0) is renderer.radiance(scene, 0, 0)


def test_twice_the_exposure_is_twice_the_light_until_it_saturates(renderer, scene):
    dark = exam.OPTICS.black_level
    short, long = (renderer.expose(scene, 0, Light(us, 0.0, False), 1).mean() - dark for us in (4000.0, 8000.0))
    assert long == pytest.approx(2 * short, rel=0.02)
    louder = renderer.expose(scene, 0, Light(4000.0, 6.0206, False), 1).mean() - dark
    assert louder == pytest.approx(2 * short, rel=0.02)
    assert renderer.expose(scene, 0, Light(500_000.0, 0.0, True), 1).min() == 255


def test_the_projector_gives_texture_where_there_is_none(renderer, scene):
    crop = (slice(560, 620), slice(800, 900))
    plain, pattern = (renderer.expose(scene, 0, light, 1)[crop].std() for light in (PLAIN, PATTERN))
    assert pattern > 3 * plain


def test_an_empty_bin_has_a_picture_too(renderer, scene):
    empty = WorldScene("A", (), 5, 2)
    difference = cv2.absdiff(renderer.radiance(scene, 0, 0), renderer.radiance(empty, 0, 0))
    # where no part lay, nothing changes; noise is the shot's
    assert (difference[550:700, 850:1150] > 0.02).any()
    assert difference[:200].max() < 1e-6
    assert renderer.expose(empty, 0, PATTERN, 1).mean() > 30


def test_it_looks_into_one_world_only(renderer):
    with pytest.raises(ValueError, match="world A"):
        renderer.radiance(WorldScene("B", (), 1, 1), 0, 0)


def rectified(renderer, scene):
    left, right = renderer._rig.cameras
    T = right.T_camera_rig
    R1, R2, P1, P2, *_ = cv2.stereoRectify(left.K_px, left.distortion_coefficients, right.K_px, right.distortion_coefficients,
                                           renderer._rig.image_size_px, T[:3, :3], T[:3, 3], flags=cv2.CALIB_ZERO_DISPARITY)
    views = []
    for i, (camera, R, P) in enumerate(((left, R1, P1), (right, R2, P2))):
        maps = cv2.initUndistortRectifyMap(camera.K_px, camera.distortion_coefficients, R, P, renderer._rig.image_size_px,
                                           cv2.CV_32FC1)
        views.append(cv2.remap(renderer.radiance(scene, i, 0) / renderer._views[i].vignette, *maps, cv2.INTER_CUBIC))
    focal, cx, cy, baseline = (float(x) for x in (P1[0, 0], P1[0, 2], P1[1, 2], -P2[0, 3] / P2[0, 0]))
    return views, geometry.make(R1.T, np.zeros(3)), focal, cx, cy, baseline


def test_the_truth_lays_one_view_over_the_other(renderer, scene):
    (left, right), T_camera_rect, focal, cx, cy, baseline = rectified(renderer, scene)
    window = Window(x=600, y=350, width=700, height=450, min_disparity=0, num_disparities=16)
    t = truth(scene, T_camera_rect, focal, cx, cy, baseline, window)
    v, u = np.mgrid[350:800, 600:1300].astype(np.float32)
    nearer, seen, further = (cv2.remap(right, u - t.disparity + np.float32(s), v, cv2.INTER_CUBIC) for s in (-0.5, 0.0, 0.5))
    slope = further - nearer
    for surface in (t.part_id == 0, t.part_id == 1, t.part_id == 2):
        # away from edges, where blur mixes two surfaces
        both = cv2.erode((surface & t.visible_both).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        assert both.sum() > 1500
        # the shift, in px, that would lay the views over each other still better (least squares)
        left_over = ((left[350:800, 600:1300] - seen) * slope)[both].sum() / (slope**2)[both].sum()
        # a part has few pixels, and its gloss looks different to each camera
        assert abs(left_over) < (0.08 if surface[both].sum() < 50_000 else 0.01)
