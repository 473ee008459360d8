"""The bin as a mark: where no tags are, a bin that is located elsewhere than expected tells of the mount, or of itself."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from binpick.geometry import Transform


@dataclass(frozen=True, slots=True)
class CarrierCheck:
    """What a bin does not do that slides on its table: `shift_m` is how much higher it seems to stand, `tilt_rad` its tilt."""

    shift_m: float
    tilt_rad: float


def check(T_expected_bin: Transform) -> CarrierCheck:
    """Of a bin as located in its expected frame, z up (`scene.location.Location.T_expected_bin`)."""
    upright = Rotation.from_matrix(T_expected_bin[:3, :3]).apply([0.0, 0.0, 1.0])
    return CarrierCheck(float(T_expected_bin[2, 3]), float(np.arccos(np.clip(upright[2], -1, 1))))
