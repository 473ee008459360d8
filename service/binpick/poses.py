"""How robot brands write an orientation; inside there is only the quaternion xyzw.

Sources: UR rotation vector (axis-angle, rad); KUKA A, B, C = rotations about Z, Y', X'' (deg); FANUC W, P, R = rotations
about the fixed X, Y, Z (deg), which is the same rotation read the other way round.
"""

from enum import IntEnum

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from binpick.geometry import Quaternion


class PoseFormat(IntEnum):
    """The number is what a PLC writes; 0 there means the recipe's own."""

    quaternion_xyzw = 1
    rotvec_rad = 2
    kuka_abc_deg = 3
    fanuc_wpr_deg = 4
    ur_rxryrz_rad = 5


def encode(quaternion_xyzw: Quaternion, pose_format: PoseFormat) -> Float[np.ndarray, "n"]:
    """Four numbers for a quaternion, three for every other format."""
    rotation = Rotation.from_quat(quaternion_xyzw)
    match pose_format:
        case PoseFormat.quaternion_xyzw:
            numbers = rotation.as_quat(canonical=True)
        case PoseFormat.rotvec_rad | PoseFormat.ur_rxryrz_rad:
            numbers = rotation.as_rotvec()
        case PoseFormat.kuka_abc_deg:
            numbers = _euler_deg(rotation, "ZYX")
        case PoseFormat.fanuc_wpr_deg:
            numbers = _euler_deg(rotation, "ZYX")[::-1]
    return np.asarray(numbers, dtype=float)


def decode(numbers: Float[np.ndarray, "n"], pose_format: PoseFormat) -> Quaternion:
    """The inverse of `encode`: a unit quaternion xyzw with w >= 0. Raises ValueError on a wrong count or zero norm."""
    numbers = np.asarray(numbers, dtype=float)
    match pose_format:
        case PoseFormat.quaternion_xyzw:
            rotation = Rotation.from_quat(numbers)
        case PoseFormat.rotvec_rad | PoseFormat.ur_rxryrz_rad:
            rotation = Rotation.from_rotvec(numbers)
        case PoseFormat.kuka_abc_deg:
            rotation = Rotation.from_euler("ZYX", numbers, degrees=True)
        case PoseFormat.fanuc_wpr_deg:
            rotation = Rotation.from_euler("ZYX", numbers[::-1], degrees=True)
    return np.asarray(rotation.as_quat(canonical=True), dtype=float)


def _euler_deg(rotation: Rotation, axes: str) -> Float[np.ndarray, "3"]:
    """Intrinsic Euler angles; at the pole (B = ±90°) the last angle is set to 0, which is the same rotation."""
    return np.asarray(rotation.as_euler(axes, degrees=True, suppress_warnings=True), dtype=float)
