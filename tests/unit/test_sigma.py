"""Sigma grows with what makes a grasp uncertain, and the bench holds it against the true errors, axis by axis."""

import numpy as np
import pytest

from binpick import geometry, settings
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Frame, StereoPair
from binpick.errors import Code
from binpick.grasp import sigma
from binpick.lab import exam, offsets
from binpick.result import GraspMessage, PoseMessage, Request, Sigma, ToolMessage, failure
from binpick.settings import Cup
from binpick.sim import exam as frozen
from binpick.sim import score
from binpick.sim.world import ScenePart, WorldScene

TOP = 0.015


def one(value):
    return np.array([float(value)])


SINGLE = (Cup(),)


def cups(sigma_px_m=0.0002, rms_m=0.0001, support=150, curved=0.0, at_edge=False, at=SINGLE):
    off = sigma.of_cups(one(sigma_px_m), one(rms_m), np.array([support], np.int32), one(curved), np.array([at_edge]), at)
    return np.array([off.xy_m[0], off.z_m[0], off.tilt_rad[0]])


def test_a_cup_is_less_certain_on_noise_on_curves_at_edges_and_on_few_pixels():
    plain = cups()
    assert (cups(sigma_px_m=0.0004) > plain).all()
    assert (cups(rms_m=0.0003) > plain).all()
    assert (cups(support=30) > plain).all()
    assert (cups(curved=1.0)[:2] > plain[:2]).all()
    assert cups(at_edge=True)[0] > plain[0]
    assert cups(at=(Cup(radius_m=0.02),))[2] < plain[2], "a wide lip tilts less"
    row = (Cup(x_m=0.03), Cup(x_m=-0.03))
    assert cups(at=row)[2] == pytest.approx(plain[2]), "a row tilts about itself"
    assert cups(at=(*row, Cup(y_m=0.03), Cup(y_m=-0.03)))[2] < plain[2] / 2


def test_no_number_of_pixels_makes_a_surface_exact():
    assert cups(support=10**8)[1] == pytest.approx(sigma.SHARED * 0.0002, rel=1e-3)


def test_two_fingers_are_less_certain_on_slanted_ends():
    square, slanted = (sigma.of_fingers(one(0.0005), one(angle)) for angle in (0.0, 0.2))
    assert (slanted.xy_m > square.xy_m).all()
    assert (slanted.z_m > square.z_m).all()
    assert (slanted.tilt_rad > square.tilt_rad).all()


SCENE = WorldScene("A", (ScenePart(3, "block", geometry.translation(0.1, 0.05, 0.0075)),), 1, 1)


def asked(kind):
    nothing = np.zeros((2, 2), np.uint8)
    frames = (Frame(nothing, name, 1, 1, 0, 0, 1, 0.0, 0.0) for name in ("left", "right"))
    pair = StereoPair(*frames, "2026-01-01T00:00:00Z", skew_us=0.0, sigma_us=0.0, proof="simulated")
    job = settings.resolve(frozen.cell("A", tools=[{"kind": kind}]), 1)
    return exam.Paper(CycleInput(1, pair, frozen.rig("A"), job, Request(), simulated=True), SCENE)


def told(kind, T_bin_tcp, open_m=0.0, close_m=0.0):
    """The errors of a pose, in units of 1 mm and of 0.1 rad."""
    x, y, z = T_bin_tcp[:3, 3].tolist()
    pose = PoseMessage(position_m=(x, y, z), quaternion_xyzw=tuple(geometry.quaternion(T_bin_tcp).tolist()))
    grasp = GraspMessage(
        id="1-1", rank=1, tool=ToolMessage(number=1, name="", kind=kind), frame="bin",
        **pose.model_dump(), T_frame_pregrasp=pose,
        approach_m=0.08, lift_m=0.15, open_m=open_m, close_m=close_m, quality=0.5, clearance_m=0.01, part_id=1,
        sigma=Sigma(xy_m=0.001, z_m=0.001, tilt_rad=0.1))
    paper = asked(kind)
    verdict = score.judge(SCENE, T_bin_tcp, paper.inputs.job.tool, open_m, close_m)
    unseen = CycleResult(failure(1, Request(), Code.NO_DEPTH))
    return offsets.in_sigmas(paper, unseen, grasp, verdict)




def down(x=0.1, y=0.05, z=TOP, tilt=0.0, along=(1.0, 0.0, 0.0)):
    return geometry.frame_of_axes(np.array([np.sin(tilt), 0.0, -np.cos(tilt)]), np.array(along), np.array([x, y, z]))


def test_a_cups_errors_are_told_along_across_and_in_tilt():
    assert told("suction", down()) == pytest.approx((0, 0, 0), abs=0.01)
    z, xy, tilt = told("suction", down(z=TOP + 0.002, tilt=0.1))
    assert (z, tilt) == (pytest.approx(2, abs=0.02), pytest.approx(1, abs=0.01))
    assert xy < 1.0, "what is looked at nearly along the approach moves little across it"
    # the edge of the block, 20 mm from its middle, cuts a third off the skirt
    assert told("suction", down(y=0.05 + 0.0165))[1] > 1


def test_two_fingers_errors_are_told_along_the_closing_axis():
    across = (0.0, 1.0, 0.0)
    z, closing, tilt = told("two_finger", down(z=0.004, y=0.0512, along=across), open_m=0.05, close_m=0.04)
    assert np.isnan(z), "nothing was seen of the part"
    assert (closing, tilt) == (pytest.approx(1.2, abs=0.01), pytest.approx(0, abs=0.01))


def test_shares_are_of_what_is_known():
    shares = offsets.within([(0.5, 1.5, float("nan")), (1.5, 0.5, 3.0)])
    assert shares["z"] == {"of": 2, "within_1": 0.5, "within_2": 1.0}
    assert shares["tilt"] == {"of": 1, "within_1": 0.0, "within_2": 0.0}
    assert offsets.within([])["xy"] == {"of": 0, "within_1": None, "within_2": None}
