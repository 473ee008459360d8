"""The frozen exam: two set-ups, five shapes of part in plastic and steel, one table of optics, seeds to tune and report on."""

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from binpick import data, geometry
from binpick.errors import InputError
from binpick.geometry import Transform
from binpick.rig import Rig, RigCamera
from binpick.settings import Cell

Triple = tuple[float, float, float]

TUNING_SEEDS = tuple(range(1, 11))
REPORT_SEEDS = tuple(range(101, 111))
IMAGE_SIZE_PX = (1936, 1216)


@dataclass(frozen=True, slots=True)
class Lens:
    """One camera: focal lengths and principal point in px, distortion in OpenCV's order k1, k2, p1, p2, k3."""

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Setup:
    """Two cameras over a bin. Angles in degrees: `bin_euler_deg` about the left camera's x, y, z (180° about x turns z up)."""

    name: str
    left: Lens
    right: Lens
    right_position_m: Triple
    right_rotvec_deg: Triple
    bin_size_m: Triple
    bin_wall_m: float
    bin_position_m: Triple
    bin_euler_deg: Triple
    base_position_m: Triple
    base_euler_deg: Triple

    @property
    def T_camera_bin(self) -> Transform:
        """Bin coordinates in the left camera's frame."""
        R = Rotation.from_euler("xyz", self.bin_euler_deg, degrees=True).as_matrix()
        return geometry.make(R, np.array(self.bin_position_m))

    @property
    def T_base_bin(self) -> Transform:
        """Bin coordinates in the robot base's frame: yawed and tilted, so that a frame error cannot hide."""
        R = Rotation.from_euler("ZYX", self.base_euler_deg, degrees=True).as_matrix()
        return geometry.make(R, np.array(self.base_position_m))


@dataclass(frozen=True, slots=True)
class Primitive:
    """A convex piece of a part, its axis along z: box (x, y, z), cylinder (Ø, Ø, length), hexagon (flats, flats, length)."""

    shape: Literal["box", "cylinder", "hexagon"]
    size_mm: Triple
    at_mm: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of part: its pieces (they may overlap), diffuse reflectance 0 to 1, and strength of its gloss.

    `mirror` is what bare metal reflects of its surroundings when looked at squarely, 0 to 1.
    """

    pieces: tuple[Primitive, ...]
    reflectance: float
    gloss: float
    mirror: float = 0.0


@dataclass(frozen=True, slots=True)
class Optics:
    """Light, surface, lens and sensor. Radiance 1 = a white diffuser under the projector's full light at 1 m.

    Noise as of a small-pixel CMOS sensor with some analogue gain (16 electrons a step of 8 bits, and 2 steps of its own).
    Blur, noise and contrast were set on the tuning seeds so that plain SGBM errs on world A's parts as it does on
    path-traced renderings of such bins: bad-1 4 to 7 %, bad-2 2 to 4 %, median 0.17 to 0.25 px. Steel's were set so that
    about half of plain SGBM's pixels on it are beyond 1 px, as measured on such renderings of dark shiny metal.
    """

    ambient: float = 0.16
    lamp: float = 0.10
    lamp_direction: Triple = (0.25, -0.35, 0.90)
    projector: float = 1.0
    projector_position_m: Triple = (0.075, -0.055, 0.0)
    dot_pitch_px: float = 5.2
    dot_sigma_px: float = 1.4
    dark_between_dots: float = 0.45
    interreflection: float = 0.35
    occlusion_height_m: float = 0.06
    gloss_power: int = 32
    texture_contrast: float = 0.05
    texture_pitch_m: float = 0.0010
    reflectance_spread: float = 0.08
    bin_reflectance: float = 0.22
    bin_gloss: float = 0.03
    table_reflectance: float = 0.30
    blur_sigma_px: float = 0.75
    vignetting: float = 0.18
    electrons_per_step: float = 16.0
    read_noise_steps: float = 2.0
    black_level: float = 2.0
    steps_per_us: float = 0.060
    metal_gloss: float = 6.0
    metal_gloss_power: int = 256
    metal_roughness_rad: float = 0.008
    surround: float = 0.16


SETUPS = {
    "A": Setup(
        name="A",
        left=Lens((1740.6, 1740.1), (972.4, 603.8), (-0.0712, 0.0918, 0.00042, -0.00058, -0.0214)),
        right=Lens((1738.9, 1739.3), (961.7, 612.5), (-0.0689, 0.0874, -0.00035, 0.00049, -0.0187)),
        right_position_m=(0.1499, 0.0011, -0.0014), right_rotvec_deg=(0.28, -0.62, 0.35),
        bin_size_m=(0.600, 0.400, 0.180), bin_wall_m=0.003,
        bin_position_m=(0.081, -0.009, 1.000), bin_euler_deg=(182.6, -1.7, 3.1),
        base_position_m=(0.58, -0.31, 0.07), base_euler_deg=(37.0, 3.0, 0.0)),
    "B": Setup(
        name="B",
        left=Lens((3480.9, 3479.8), (964.9, 611.2), (-0.0436, 0.1120, -0.00031, 0.00044, -0.0720)),
        right=Lens((3477.6, 3478.3), (971.8, 604.1), (-0.0402, 0.0965, 0.00037, -0.00029, -0.0555)),
        right_position_m=(0.1500, -0.0009, 0.0012), right_rotvec_deg=(-0.21, -0.78, 0.30),
        bin_size_m=(0.300, 0.200, 0.120), bin_wall_m=0.003,
        bin_position_m=(0.069, 0.004, 0.950), bin_euler_deg=(178.1, 0.8, -1.4),
        base_position_m=(0.46, 0.22, -0.05), base_euler_deg=(37.0, 3.0, 0.0)),
}

KINDS = {
    "block": Kind((Primitive("box", (60.0, 40.0, 15.0)),), 0.46, 0.05),
    "cylinder": Kind((Primitive("cylinder", (24.0, 24.0, 60.0)),), 0.36, 0.35),
    "tee": Kind((Primitive("box", (64.0, 16.0, 16.0), (0.0, 22.0, 0.0)), Primitive("box", (16.0, 60.0, 16.0))), 0.40, 0.10),
    "bracket": Kind((Primitive("box", (50.0, 40.0, 4.0), (0.0, 0.0, -13.0)),
                     Primitive("box", (4.0, 40.0, 30.0), (-23.0, 0.0, 0.0))), 0.52, 0.25),
    "bolt": Kind((Primitive("cylinder", (12.0, 12.0, 57.5)),
                  Primitive("hexagon", (19.0, 19.0, 7.5), (0.0, 0.0, 25.0))), 0.42, 0.30),
}

STEEL_REFLECTANCE, STEEL_MIRROR = 0.03, 0.60
MIXTURES = {"mixed": tuple(KINDS), "metal": tuple(f"steel-{shape}" for shape in KINDS)}
KINDS |= {steel: Kind(KINDS[shape].pieces, STEEL_REFLECTANCE, 0.0, STEEL_MIRROR)
          for shape, steel in zip(MIXTURES["mixed"], MIXTURES["metal"], strict=True)}

OPTICS = Optics()


def setup(name: str) -> Setup:
    """A set-up by its name. Raises InputError."""
    if name not in SETUPS:
        raise InputError(f"there is no exam world {name!r}; there are {', '.join(SETUPS)}")
    return SETUPS[name]


def kinds(mixture: str, count: int) -> tuple[str, ...]:
    """The kinds of `count` parts in equal shares: of one kind, of some as "block+tee", or of a mixture. Raises InputError."""
    chosen = MIXTURES.get(mixture) or tuple(mixture.split("+"))
    if unknown := [kind for kind in chosen if kind not in KINDS]:
        raise InputError(f"there is no kind of part {unknown[0]!r}; there are {', '.join([*MIXTURES, *KINDS])}")
    return tuple(chosen[i % len(chosen)] for i in range(count))


def rig(world: str) -> Rig:
    """The rig as a perfect calibration would find it."""
    s = setup(world)
    R_rig_right = Rotation.from_rotvec(s.right_rotvec_deg, degrees=True).as_matrix()
    T_right_rig = geometry.inverse(geometry.make(R_rig_right, np.array(s.right_position_m)))
    cameras = (_camera("left", "SIM-LEFT", s.left, np.eye(4)), _camera("right", "SIM-RIGHT", s.right, T_right_rig))
    return Rig.model_validate({
        "image_size_px": IMAGE_SIZE_PX,
        "cameras": cameras,
        "T_base_rig": (s.T_base_bin @ geometry.inverse(s.T_camera_bin)).tolist(),
    })


def _camera(name: str, serial: str, lens: Lens, T_cam_rig: Transform) -> RigCamera:
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    return RigCamera.model_validate({
        "name": name, "serial": serial, "K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        "distortion": lens.distortion, "T_cam_rig": T_cam_rig.tolist()})


def cell(world: str, bin_frame: Literal["camera", "base"] = "camera", **settings: Any) -> Cell:
    """A cell file for a set-up: default tool; recipe 1 speaks UR rotation vectors, recipe 2 quaternions, both in `base`.

    `settings` are top-level keys of the cell file, which replace those made here.
    """
    s = setup(world)
    T_parent_bin = s.T_camera_bin if bin_frame == "camera" else s.T_base_bin
    document: dict[str, Any] = {
        "bin": {
            "inner_size_m": s.bin_size_m, "wall_m": s.bin_wall_m,
            "pose": {"frame": bin_frame, "position_m": T_parent_bin[:3, 3].tolist(),
                     "quaternion_xyzw": geometry.quaternion(T_parent_bin).tolist()}},
        "recipes": [
            {"number": 1, "name": "ur", "pose_format": "ur_rxryrz_rad", "frame": "base"},
            {"number": 2, "name": "quaternion", "pose_format": "quaternion_xyzw", "frame": "base"}],
    }
    return Cell.model_validate(document | settings)


def sha256() -> str:
    """Names the exam: any change of a table changes it."""
    tables = {
        "setups": {k: asdict(v) for k, v in SETUPS.items()}, "kinds": {k: asdict(v) for k, v in KINDS.items()},
        "optics": asdict(OPTICS), "image": IMAGE_SIZE_PX, "tuning": TUNING_SEEDS, "report": REPORT_SEEDS,
        "mixtures": MIXTURES, "patterns": (data.DOT_PATTERNS, data.GRAY_CODE_SIZE_PX),
    }
    return hashlib.sha256(json.dumps(tables, sort_keys=True).encode()).hexdigest()
