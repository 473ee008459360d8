"""True disparity equals what the pinhole formula says."""

import numpy as np

from binpick import geometry
from binpick.data import Window
from binpick.sim import exam
from binpick.sim.truth import truth
from binpick.sim.world import ScenePart, WorldScene

WINDOW = Window(x=950, y=560, width=120, height=80, min_disparity=200, num_disparities=128)
FOCAL, CX, CY, BASELINE = 1740.0, 960.0, 600.0, 0.15


def look(*parts):
    return truth(WorldScene("A", parts, 1, 1), np.eye(4), FOCAL, CX, CY, BASELINE, WINDOW)


def test_the_floor_of_an_empty_bin_is_where_it_should_be():
    t = look()
    T = exam.setup("A").T_camera_bin
    normal, origin = T[:3, 2], T[:3, 3]
    u, v = np.meshgrid(np.arange(950, 1070), np.arange(560, 640))
    rays = np.stack([(u - CX) / FOCAL, (v - CY) / FOCAL, np.ones(u.shape)], axis=-1)
    z = (normal @ origin) / (rays @ normal)
    assert np.abs(t.disparity - FOCAL * BASELINE / z).max() < 2e-3
    assert (t.part_id == 0).all()
    assert t.visible_both.all()


def test_a_part_shows_its_id_and_hides_the_floor_from_the_right_camera():
    centre = np.array([(1010 - CX) / FOCAL, (600 - CY) / FOCAL, 1.0]) * 0.97
    at = geometry.transform(geometry.inverse(exam.setup("A").T_camera_bin), centre)
    t = look(ScenePart(4, "block", geometry.translation(at[0], at[1], 0.04)))
    assert set(np.unique(t.part_id)) == {0, 4}
    assert np.median(t.disparity[t.part_id == 4]) > np.median(t.disparity[t.part_id == 0]) + 8
    hidden = np.argwhere(~t.visible_both)
    assert len(hidden) > 100
    # the right camera looks under the part from the right: what it cannot see lies left of it
    assert hidden[:, 1].mean() < np.argwhere(t.part_id == 4)[:, 1].mean()
