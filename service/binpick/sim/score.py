"""The judge: would this grasp hold, and touch nothing else? It knows the true world and nothing of perception."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from binpick.geometry import Transform, frame_of_axes
from binpick.settings import SuctionTool, Tool
from binpick.sim import exam, pinch
from binpick.sim.collision import Grip, Surroundings
from binpick.sim.mesh import Caster
from binpick.sim.world import WorldScene

# a suction grasp is good within these, and with the tool's own compliance (DECISIONS: how grasps are judged)
MAX_TILT_RAD = np.radians(15.0)
MAX_DISTANCE_M = 0.004
MAX_PENETRATION_M = 0.001
RING_RAYS = 48
# rays start this far above the TCP: what hangs lower over the cup is in its way
START_M = 0.03
GRID_M = 0.004
TRIES_PER_PART = 24


@dataclass(frozen=True, slots=True)
class Verdict:
    """What would become of a grasp. `reason` is "" when it is ok; `part_id` is 0 and `kind` "" where no part is.

    `distance_m` is from the TCP to the true surface along the approach (positive: the TCP hangs above it), `angle_rad`
    between approach and true surface, `ring_rms_m` how far the surface under the lip is from flat; all NaN without a part.
    Of two fingers, `distance_m` is how far the part is wider than was said, `angle_rad` the larger of both contacts' angles to
    the closing axis, `ring_rms_m` NaN.
    """

    part_id: int
    kind: str
    ok: bool
    reason: str
    distance_m: float
    angle_rad: float
    ring_rms_m: float
    penetration_m: float


@dataclass(frozen=True, slots=True)
class Contact:
    """What lies under the cups, or between the fingers: the part (0: none), and how they would sit on it."""

    part_id: int
    reason: str
    distance_m: float = float("nan")
    angle_rad: float = float("nan")
    rms_m: float = float("nan")


def judge(scene: WorldScene, T_bin_tcp: Transform, tool: Tool, open_m: float = 0.0, close_m: float = 0.0) -> Verdict:
    """The verdict on one grasp; z of the TCP into the part. Two fingers come `open_m` wide and expect a part of `close_m`."""
    grip = None
    if isinstance(tool, SuctionTool):
        contact = _contacts(Caster(scene), T_bin_tcp[None], tool)[0]
    else:
        met = pinch.close(Caster(scene), T_bin_tcp, tool.fingers, open_m)
        grip = Grip(open_m, met.low_m, met.high_m, met.part_id)
        contact = Contact(met.part_id, met.reason, met.high_m - met.low_m - close_m, met.angle_rad)
    depth = Surroundings(scene).penetration(T_bin_tcp, tool, grip)
    reason = contact.reason or ("the tool collides" if depth > MAX_PENETRATION_M else "")
    kind = next((p.kind for p in scene.parts if p.part_id == contact.part_id), "")
    return Verdict(contact.part_id, kind, not reason, reason, contact.distance_m, contact.angle_rad, contact.rms_m, depth)


def pickable(scene: WorldScene, tool: SuctionTool) -> frozenset[int]:
    """The parts that some grasp of this tool could take: along the surface normal, or straight down, anywhere seen from above.

    Every part gets up to TRIES_PER_PART collision checks, spread over the places where the cup would seal. Takes some seconds.
    """
    caster = Caster(scene)
    poses = _candidates(scene, caster, tool)
    sealing: dict[int, list[Transform]] = {}
    for pose, contact in zip(poses, _contacts(caster, poses, tool), strict=True):
        if not contact.reason:
            sealing.setdefault(contact.part_id, []).append(pose)
    around = Surroundings(scene)
    return frozenset(
        part_id for part_id, tries in sealing.items()
        if any(around.penetration(pose, tool) <= MAX_PENETRATION_M for pose in tries[::max(1, len(tries) // TRIES_PER_PART)]))


def _candidates(scene: WorldScene, caster: Caster, tool: SuctionTool) -> Float[np.ndarray, "n 4 4"]:
    length, width, height = exam.setup(scene.world).bin_size_m
    x, y = np.meshgrid(np.arange(-length / 2, length / 2, GRID_M), np.arange(-width / 2, width / 2, GRID_M))
    rays = np.zeros((x.size, 6), np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = x.ravel(), y.ravel(), height + 0.5, -1
    hits = caster.cast(rays)
    points = rays[:, :3] + rays[:, 3:] * hits.distance[:, None]
    on_parts = np.flatnonzero((hits.part_id > 0) & (hits.normal[:, 2] > np.cos(tool.max_tilt_rad)))
    along, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    poses = [frame_of_axes(axis, along, points[i].astype(float))
             for i in on_parts for axis in (-hits.normal[i].astype(float), down)]
    return np.array(poses).reshape(-1, 4, 4)


def _contacts(caster: Caster, poses: Float[np.ndarray, "n 4 4"], tool: SuctionTool) -> list[Contact]:
    """What the lips of each pose meet, by rays along the approach."""
    lips = _lips(tool)
    origins = np.einsum("nij,rj->nri", poses[:, :3, :3], lips - [0, 0, START_M]) + poses[:, None, :3, 3]
    approach = np.broadcast_to(poses[:, None, :3, 2], origins.shape)
    rays = np.concatenate([origins, approach], axis=-1).astype(np.float32)
    hits = caster.cast(rays.reshape(-1, 6))
    distance, part_id = (a.reshape(len(poses), len(lips)) for a in (hits.distance, hits.part_id))
    return [_contact(rays[i], distance[i], part_id[i], tool) for i in range(len(poses))]


def _lips(tool: SuctionTool) -> Float[np.ndarray, "n 3"]:
    """The TCP, then points on every lip, in the TCP's frame."""
    angles = np.arange(RING_RAYS) * 2 * np.pi / RING_RAYS
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(RING_RAYS)])
    return np.vstack([np.zeros((1, 3)), *(ring * cup.radius_m + [cup.x_m, cup.y_m, 0] for cup in tool.cups)])


def _contact(rays: Float32[np.ndarray, "n 6"], distance: Float32[np.ndarray, "n"], part_id: np.ndarray,
             tool: SuctionTool) -> Contact:
    part, gap = int(part_id[0]), float(distance[0]) - START_M
    if part <= 0:
        return Contact(0, "there is no part")
    if (part_id != part).any():
        return Contact(part, "the cup is not on one part", gap)
    points = (rays[:, :3] + rays[:, 3:] * distance[:, None]).astype(float)
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred)[2][2]
    off = centred @ normal
    angle = float(np.arccos(min(1.0, abs(normal @ rays[0, 3:].astype(float)))))
    reason = ""
    if np.abs(off).max() > tool.compliance_m:
        reason = "the surface under the cup is not even"
    elif angle > MAX_TILT_RAD:
        reason = "the cup is tilted against the surface"
    elif abs(gap) > MAX_DISTANCE_M:
        reason = "the cup is too far from the surface, or inside it"
    return Contact(part, reason, gap, angle, float(np.sqrt(np.mean(off**2))))
