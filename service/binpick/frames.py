"""Where camera, bin and base stand to each other in one cycle."""

from dataclasses import dataclass, replace

import numpy as np

from binpick.cycle import CycleInput
from binpick.errors import FrameUnavailable
from binpick.geometry import Transform
from binpick.result import FrameName
from binpick.scene import bin as load_carrier
from binpick.scene.location import Location


@dataclass(frozen=True, slots=True)
class Frames:
    """Where camera, bin and base stand to each other in this cycle; `location` is how the bin was located, if it was to be."""

    T_camera_bin: Transform
    T_base_camera: Transform | None
    location: Location | None = None

    @classmethod
    def of(cls, inputs: CycleInput) -> "Frames":
        """With the bin where the cell file expects it."""
        return cls(load_carrier.place(inputs.job.bin, inputs.T_base_camera), inputs.T_base_camera)

    def located(self, found: Location) -> "Frames":
        """With the bin where its rim was found."""
        return replace(self, T_camera_bin=self.T_camera_bin @ found.T_expected_bin, location=found)

    def T_frame_bin(self, frame: FrameName) -> Transform:
        """Maps bin coordinates to the frame of that name; `admit` has proved that it exists."""
        if frame == "bin":
            return np.eye(4)
        if frame == "camera":
            return self.T_camera_bin
        if self.T_base_camera is None:
            raise FrameUnavailable('poses in "base" need a hand-eye calibration')
        T_base_bin: Transform = self.T_base_camera @ self.T_camera_bin
        return T_base_bin

    @property
    def T_reach_bin(self) -> Transform:
        """The reach box lives in the base where there is one, else in the camera's frame."""
        return self.T_frame_bin("camera" if self.T_base_camera is None else "base")
