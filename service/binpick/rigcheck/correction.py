"""Correction: the rig with its second camera turned by the small angle that production pairs show."""

from binpick.rig import Rig

MOST_RAD = 0.002
"""A larger turn is no drift but a bump: calibrate again. 3.5 px with a 6 mm lens of 1740 px, 7 px with 12 mm."""


def corrected(rig: Rig, rotation_rad: tuple[float, float, float]) -> Rig:
    """The rig as it is after its second camera turned by (pitch, yaw, roll), as in `rows.Rows` and `marks.MarksCheck`.

    Give the rig of the file and the sum of all turns found since, so that the bound holds for them all. Raises InputError
    beyond `MOST_RAD`, or when an angle is not finite.
    """
    raise NotImplementedError
