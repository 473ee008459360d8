"""A bin of parts that really settle (MuJoCo): what the cameras see, and what the robot takes from."""

import hashlib
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform
from binpick.sim import exam
from binpick.sim.exam import Triple

STEP_S = 0.002
CALM_M_S, CALM_RAD_S = 0.004, 0.10
CALM_STEPS = 40
LONGEST_S = 5.0
# air: slows everything by this share a second; thick after a while, so that rolling and rocking end
AIR_PER_S, THICK_AIR_PER_S, THICK_AFTER_S = 1.0, 10.0, 1.5
GUIDE_M = 0.6
FRICTION = (0.45, 0.003, 0.0004)
# rolling resistance too, and stiff friction: without them piles creep
CONDIM, IMPEDANCE_RATIO = 6, 10.0
DENSITY = 2700.0
SPAWN_PITCH_M = 0.085


@dataclass(frozen=True, slots=True, eq=False)
class ScenePart:
    """One part where it lies; ids count from 1."""

    part_id: int
    kind: str
    T_bin_part: Transform


@dataclass(frozen=True, slots=True, eq=False)
class WorldScene:
    """The world at rest: everything that rendering and judging read. `revision` grows with every change."""

    world: str
    parts: tuple[ScenePart, ...]
    seed: int
    revision: int

    @property
    def digest(self) -> str:
        """Names what lies where: equal digests look equal."""
        key = hashlib.sha256(self.world.encode())
        for part in self.parts:
            key.update(f"{part.part_id} {part.kind}".encode() + part.T_bin_part.tobytes())
        return key.hexdigest()


class World:
    """Drops `count` parts into the bin of exam world `name` and lets them settle; same arguments, same world."""

    def __init__(self, name: str, kinds: str, count: int, seed: int) -> None:
        """`kinds` as in `exam.kinds`. Raises InputError."""
        self._setup = exam.setup(name)
        self._seed = seed
        self._revision = 0
        self._rng = np.random.default_rng(seed)
        chosen = exam.kinds(kinds, count)
        self._kinds = dict(enumerate((chosen[i] for i in self._rng.permutation(count)), start=1))
        self._poses = dict(zip(self._kinds, self._spawn(count), strict=True))
        self.settle()

    def scene(self) -> WorldScene:
        """The world as it lies now."""
        parts = tuple(ScenePart(i, self._kinds[i], T.copy()) for i, T in self._poses.items())
        return WorldScene(self._setup.name, parts, self._seed, self._revision)

    def remove(self, part_id: int) -> None:
        """Takes a part out; the others stay where they are until `settle`. Raises KeyError."""
        del self._poses[part_id]
        self._revision += 1

    def settle(self) -> None:
        """Lets everything come to rest; what fell out of the bin is dropped in again, at last left out."""
        self._poses = self._fall(self._poses)
        for _ in range(3):
            if not (outside := [i for i, T in self._poses.items() if not self._inside(T)]):
                break
            self._poses |= dict(zip(outside, self._spawn(len(outside)), strict=True))
            self._poses = self._fall(self._poses)
        self._poses = {i: T for i, T in self._poses.items() if self._inside(T)}
        self._revision += 1

    def _inside(self, T_bin_part: Transform) -> bool:
        length, width, _ = self._setup.bin_size_m
        x, y, z = T_bin_part[:3, 3]
        return bool(abs(x) < length / 2 and abs(y) < width / 2 and z > 0)

    def _spawn(self, count: int) -> list[Transform]:
        """Poses above the bin that do not touch each other: layers on a grid, loosely over the middle, turned at random."""
        length, width, height = self._setup.bin_size_m
        columns, rows = (max(1, int((side * 0.75) / SPAWN_PITCH_M)) for side in (length, width))
        poses = []
        for i in range(count):
            layer, cell = divmod(i, columns * rows)
            row, column = divmod(cell, columns)
            at = np.array([(column - (columns - 1) / 2) * SPAWN_PITCH_M, (row - (rows - 1) / 2) * SPAWN_PITCH_M,
                           height * 0.5 + 0.08 * (layer + 0.5)])
            at += self._rng.uniform(-0.004, 0.004, 3)
            poses.append(geometry.make(Rotation.random(rng=self._rng).as_matrix(), at))
        return poses

    def _fall(self, poses: dict[int, Transform]) -> dict[int, Transform]:
        if not poses:
            return {}
        model = spec(self._setup, [self._kinds[i] for i in poses]).compile()
        data = mujoco.MjData(model)
        data.qpos[:] = np.concatenate([np.r_[T[:3, 3], geometry.quaternion(T)[[3, 0, 1, 2]]] for T in poses.values()])
        _rest(model, data)
        # guides kept the falling parts over the bin; what leans on them now has to find its own place
        for g in range(model.ngeom):
            if model.geom(g).name.startswith("guide"):
                model.geom_contype[g] = model.geom_conaffinity[g] = 0
        _rest(model, data)
        return {i: geometry.from_quaternion(q[:3], q[[4, 5, 6, 3]])
                for i, q in zip(poses, np.array(data.qpos).reshape(-1, 7), strict=True)}


def _rest(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Steps until nothing has moved for a while."""
    inertia = np.concatenate([np.r_[[m] * 3, i] for m, i in zip(model.body_mass[1:], model.body_inertia[1:], strict=True)])
    calm, start = 0, data.time
    while calm < CALM_STEPS and data.time - start < LONGEST_S:
        model.dof_damping[:] = inertia * (AIR_PER_S if data.time - start < THICK_AFTER_S else THICK_AIR_PER_S)
        mujoco.mj_step(model, data)
        calm = calm + 1 if _is_calm(data.qvel) else 0


def _is_calm(velocity: Float[np.ndarray, "n"]) -> bool:
    v = velocity.reshape(-1, 2, 3)
    return bool(np.abs(v[:, 0]).max() < CALM_M_S and np.abs(v[:, 1]).max() < CALM_RAD_S)


def spec(setup: exam.Setup, kinds: list[str]) -> mujoco.MjSpec:
    """The bin with guides above its walls, and these parts in this order, each on a free joint."""
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPEDANCE_RATIO
    _add_bin(spec, setup)
    for shape in {p for kind in kinds for p in exam.KINDS[kind].pieces if p.shape == "hexagon"}:
        spec.add_mesh(name=_mesh_name(shape), uservert=_hexagon(shape).ravel())
    for kind in kinds:
        body = spec.worldbody.add_body()
        body.add_freejoint()
        for piece in exam.KINDS[kind].pieces:
            _add_piece(body, piece)
    return spec


def _add_bin(spec: mujoco.MjSpec, setup: exam.Setup) -> None:
    """Floor and walls with their true inner faces; thick outside, so that nothing is pushed through."""
    length, width, height = (side / 2 for side in setup.bin_size_m)
    thick = 0.05
    boxes: list[tuple[str, Triple, Triple]] = [("floor", (0, 0, -thick), (length + 2 * thick, width + 2 * thick, thick))]
    for name, z, half in (("wall", height, height), ("guide", 2 * height + GUIDE_M / 2, GUIDE_M / 2)):
        for sign in (-1, 1):
            boxes.append((f"{name}x{sign}", (sign * (length + thick), 0, z), (thick, width + 2 * thick, half)))
            boxes.append((f"{name}y{sign}", (0, sign * (width + thick), z), (length + 2 * thick, thick, half)))
    for name, at, half_size in boxes:
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=at, size=half_size, friction=FRICTION,
                                condim=CONDIM)


def _add_piece(body: mujoco.MjsBody, piece: exam.Primitive) -> None:
    at, size = (np.array(v) / 1000 for v in (piece.at_mm, piece.size_mm))
    common = {"pos": at, "friction": FRICTION, "condim": CONDIM, "density": DENSITY}
    if piece.shape == "box":
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size / 2, **common)
    elif piece.shape == "cylinder":
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[size[0] / 2, size[2] / 2, 0], **common)
    else:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=_mesh_name(piece), **common)


def _mesh_name(piece: exam.Primitive) -> str:
    return f"hexagon {piece.size_mm[0]} {piece.size_mm[2]}"


def _hexagon(piece: exam.Primitive) -> Float[np.ndarray, "12 3"]:
    """The corners of a hexagonal prism; the first lies on x, as in the mesh that is rendered."""
    angle = np.arange(6) * np.pi / 3
    radius, half = piece.size_mm[0] / np.sqrt(3) / 1000, piece.size_mm[2] / 2000
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    return np.vstack([np.column_stack([ring, np.full(6, z)]) for z in (-half, half)])
