"""What every settings model shares: frozen, no unknown keys, no NaN; and a pose as people write one."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from binpick import geometry, poses
from binpick.geometry import Transform

Number = Annotated[int, Field(ge=1, le=65535, description="Number on the wire, 1 to 65535.")]
Metres = Annotated[float, Field(ge=-10, le=10)]
Position = tuple[Metres, Metres, Metres]


class Strict(BaseModel):
    """Frozen; an unknown key or a NaN is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class Placement(Strict):
    """A position in metres and exactly one orientation; the identity rotation when none is given."""

    position_m: Position = (0.0, 0.0, 0.0)
    """Origin in the parent frame, metres."""
    quaternion_xyzw: tuple[float, float, float, float] | None = None
    """Orientation as a quaternion x, y, z, w."""
    rotvec_rad: tuple[float, float, float] | None = None
    """Orientation as a rotation vector, radians."""
    kuka_abc_deg: tuple[float, float, float] | None = None
    """Orientation as KUKA A, B, C, degrees."""
    fanuc_wpr_deg: tuple[float, float, float] | None = None
    """Orientation as FANUC W, P, R, degrees."""
    ur_rxryrz_rad: tuple[float, float, float] | None = None
    """Orientation as a UR rotation vector, radians."""

    @model_validator(mode="after")
    def _one_orientation(self) -> "Placement":
        given = [f.name for f in poses.PoseFormat if getattr(self, f.name) is not None]
        if len(given) > 1:
            raise ValueError(f"give exactly one orientation, not {' and '.join(given)}")
        if self.quaternion_xyzw is not None and abs(np.linalg.norm(self.quaternion_xyzw) - 1) > 1e-3:
            raise ValueError("quaternion_xyzw must have length 1 (within 0.001)")
        return self

    @property
    def T_parent_this(self) -> Transform:
        """Maps this placement's coordinates to its parent's."""
        for pose_format in poses.PoseFormat:
            numbers = getattr(self, pose_format.name)
            if numbers is not None:
                return geometry.from_quaternion(np.array(self.position_m),
                                                poses.decode(np.array(numbers), pose_format))
        return geometry.translation(*self.position_m)
