"""The lift itself, in MuJoCo: a cup sucks or two fingers close, the hand rises, and the part follows or is left behind."""

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform
from binpick.settings import SuctionTool, Tool, TwoFingerTool
from binpick.sim import exam, world
from binpick.sim.mesh import Caster
from binpick.sim.world import WorldScene

VACUUM_PA = 50_000.0
"""Below the air outside: what an ejector holds on a lip that leaks a little."""
GRIP_N = 40.0
"""What each finger presses with: a small electric gripper."""
GRIP_S, REST_S, SPEED_M_S = 0.4, 0.15, 0.25
"""Time to get hold, to hang at last, and the hand's speed between."""
FEET, FOOT_M, SUNK_M = 12, 0.001, 0.0001
"""A lip is that many small feet where the surface under it is, each sunk in a little: bellows follow what is not flat."""
REACH_M = 0.002
"""A lip keeps sucking that far off the surface."""
HAND_KG, STIFFNESS, DAMPING = 2.0, 2e5, 2e3
"""The hand on its vertical guide, and the servo that raises it: it sags by 0.1 mm."""
FINGER_KG, CLOSING_M_S = 0.1, 0.2
"""Slow enough that a pad cannot pass through a part within a step."""
STAYS_M, STAYS_RAD = 0.010, np.radians(30.0)
"""How far a part may slip and turn in the hand and still count as held."""


@dataclass(frozen=True, slots=True)
class Lift:
    """What became of the part in hand: how high it rose, how far it slipped and turned; `others` came along unasked."""

    held: bool
    raised_m: float
    slipped_m: float
    turned_rad: float
    others: int


def lift(scene: WorldScene, T_bin_tcp: Transform, tool: Tool, part_id: int, open_m: float = 0.0) -> Lift:
    """Grips part `part_id` of a resting scene there and raises it by the tool's `lift_m` along the bin's z.

    The tool's bodies are not in the way here: that nothing is hit has been judged before (`score.judge`).
    """
    spec = world.spec(exam.setup(scene.world), [part.kind for part in scene.parts])
    for geom in [geom for geom in spec.worldbody.geoms if geom.name.startswith("guide")]:
        spec.delete(geom)
    hand = spec.worldbody.add_body(name="hand", pos=T_bin_tcp[:3, 3], quat=geometry.quaternion(T_bin_tcp)[[3, 0, 1, 2]],
                                   gravcomp=1.0)
    hand.add_joint(name="rise", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=T_bin_tcp[2, :3])
    hand.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=[0, 0, -0.1], mass=HAND_KG, contype=0,
                  conaffinity=0)
    servo = spec.add_actuator(name="rise", target="rise", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=STIFFNESS, kv=DAMPING)
    if isinstance(tool, SuctionTool):
        _add_cups(spec, hand, tool, scene, T_bin_tcp)
    else:
        _add_fingers(spec, hand, tool, open_m)
    return _raise(spec.compile(), scene, tool.lift_m, [part.part_id for part in scene.parts].index(part_id))


def _add_cups(spec: mujoco.MjSpec, hand: mujoco.MjsBody, tool: SuctionTool, scene: WorldScene, T_bin_tcp: Transform) -> None:
    angles = np.arange(FEET) * 2 * np.pi / FEET
    for cup in tool.cups:
        feet = np.column_stack([cup.x_m + cup.radius_m * np.cos(angles), cup.y_m + cup.radius_m * np.sin(angles),
                                np.full(FEET, -0.03)])
        rays = np.hstack([geometry.transform(T_bin_tcp, feet), np.tile(T_bin_tcp[:3, 2], (FEET, 1))]).astype(np.float32)
        gaps = Caster(scene).cast(rays).distance.astype(float)
        for foot, gap in zip(feet, gaps, strict=True):
            if np.isfinite(gap):
                hand.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[FOOT_M, 0, 0], mass=0.001, friction=world.FRICTION,
                              condim=world.CONDIM, margin=REACH_M, gap=REACH_M,
                              pos=[foot[0], foot[1], foot[2] + gap - FOOT_M + SUNK_M])
    area_m2 = sum(np.pi * cup.radius_m**2 for cup in tool.cups)
    vacuum = spec.add_actuator(name="vacuum", target="hand", trntype=mujoco.mjtTrn.mjTRN_BODY)
    vacuum.set_to_adhesion(gain=VACUUM_PA * area_m2)
    vacuum.ctrlrange = [0, 1]


def _add_fingers(spec: mujoco.MjSpec, hand: mujoco.MjsBody, tool: TwoFingerTool, open_m: float) -> None:
    """Both fingers move alike, as in a parallel gripper: what is between them is centred."""
    fingers = tool.fingers
    size_m = fingers.thickness_m, fingers.pad_width_m, fingers.length_m
    for name, side in (("low", -1), ("high", 1)):
        finger = hand.add_body(name=name, pos=[side * (open_m + size_m[0]) / 2, 0, -size_m[2] / 2], gravcomp=1.0)
        finger.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-side, 0, 0], damping=GRIP_N / CLOSING_M_S)
        finger.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=np.array(size_m) / 2, mass=FINGER_KG,
                        friction=world.FRICTION, condim=world.CONDIM)
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="low", name2="high", objtype=mujoco.mjtObj.mjOBJ_JOINT,
                      data=[0, 1] + [0] * 10)


def _raise(model: mujoco.MjModel, scene: WorldScene, height_m: float, part: int) -> Lift:
    data = mujoco.MjData(model)
    bodies = [1 + i for i in range(len(scene.parts))]
    for i, here in enumerate(scene.parts):
        data.qpos[7 * i:7 * i + 7] = np.r_[here.T_bin_part[:3, 3], geometry.quaternion(here.T_bin_part)[[3, 0, 1, 2]]]
    hand = model.body("hand").id
    gripping = [i for i in range(model.nu) if model.actuator(i).name != "rise"]
    data.ctrl[gripping] = 1.0 if model.actuator(gripping[0]).name == "vacuum" else GRIP_N
    _run(model, data, GRIP_S, 0.0, 0.0)
    before = data.xpos[bodies, 2].copy()
    T_hand_part = _relative(data, hand, bodies[part])
    _run(model, data, height_m / SPEED_M_S, 0.0, height_m)
    _run(model, data, REST_S, height_m, height_m)
    moved = geometry.inverse(T_hand_part) @ _relative(data, hand, bodies[part])
    raised = data.xpos[bodies, 2] - before
    slipped, turned = float(np.linalg.norm(moved[:3, 3])), float(Rotation.from_matrix(moved[:3, :3]).magnitude())
    others = int((np.delete(raised, part) > height_m / 2).sum())
    return Lift(bool(slipped < STAYS_M and turned < STAYS_RAD), float(raised[part]), slipped, turned, others)


def _run(model: mujoco.MjModel, data: mujoco.MjData, seconds: float, start_m: float, end_m: float) -> None:
    """Steps while the hand goes from one height to another, smoothly."""
    steps = max(1, round(seconds / model.opt.timestep))
    for step in range(steps):
        share = (1 - np.cos(np.pi * (step + 1) / steps)) / 2
        data.actuator("rise").ctrl = start_m + (end_m - start_m) * share
        mujoco.mj_step(model, data)


def _relative(data: mujoco.MjData, hand: int, part: int) -> Transform:
    poses = (geometry.make(data.xmat[body].reshape(3, 3), data.xpos[body]) for body in (hand, part))
    T_bin_hand, T_bin_part = poses
    T_hand_part: Transform = geometry.inverse(T_bin_hand) @ T_bin_part
    return T_hand_part
