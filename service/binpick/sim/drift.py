"""Drift of a simulated rig: where its cameras really are by now, while the rig file still says where they were."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from binpick import geometry
from binpick.geometry import Transform
from binpick.rig import Rig
from binpick.sim.exam import Triple


@dataclass(frozen=True, slots=True)
class Drift:
    """What has moved since the calibration: the second camera turned about its own x, y and z (a rotation vector), and the
    mount of both cameras, shifted and turned in the frame of the rig as it was."""

    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    roll_rad: float = 0.0
    shift_m: Triple = (0.0, 0.0, 0.0)
    turn_rad: Triple = (0.0, 0.0, 0.0)

    def rig(self, rig: Rig) -> Rig:
        """The rig as it truly is, of the rig as it was calibrated."""
        turn = Rotation.from_rotvec([self.pitch_rad, self.yaw_rad, self.roll_rad]).as_matrix()
        second = rig.cameras[1]
        T_cam_rig = geometry.inverse(geometry.make(turn, np.zeros(3))) @ second.T_camera_rig
        turned = second.model_copy(update={"T_cam_rig": tuple(map(tuple, T_cam_rig.tolist()))})
        return rig.model_copy(update={"cameras": (rig.cameras[0], turned, *rig.cameras[2:])})

    @property
    def T_was_rig(self) -> Transform:
        """The rig's pose in the frame of the rig as it was."""
        return geometry.make(Rotation.from_rotvec(self.turn_rad).as_matrix(), np.array(self.shift_m))


NONE = Drift()
