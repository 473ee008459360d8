"""The shapes of a tool's bodies: boxes, cylinders, and CAD files, which count as their convex hull."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial import ConvexHull, QhullError

from binpick.errors import SettingsError
from binpick.settings.base import Placement, Position, Strict

UNITS_M = {"m": 1.0, "mm": 0.001}
PLAUSIBLE_M = (0.003, 2.0)
"""The longest side of a tool's body; what is not within was drawn in another unit."""


class Box(Strict):
    """A box, centred on its own frame."""

    shape: Literal["box"]
    size_m: tuple[Annotated[float, Field(gt=0, le=2)], Annotated[float, Field(gt=0, le=2)],
                  Annotated[float, Field(gt=0, le=2)]]
    """Full edge lengths, metres."""
    T_tcp_body: Placement = Placement()
    """Where the body sits relative to the TCP."""


class Cylinder(Strict):
    """A cylinder along its own z, centred."""

    shape: Literal["cylinder"]
    radius_m: Annotated[float, Field(gt=0, le=1)]
    """Radius, metres."""
    length_m: Annotated[float, Field(gt=0, le=2)]
    """Full length, metres."""
    T_tcp_body: Placement = Placement()
    """Where the body sits relative to the TCP."""


class Mesh(Strict):
    """A CAD file. It counts as its convex hull: a tool with hollows that matter is several files."""

    shape: Literal["mesh"]
    file: Path
    """STL, OBJ or PLY, relative to the cell file."""
    unit: Literal["m", "mm"]
    """What the file's numbers are."""
    T_tcp_body: Placement = Placement()
    """Where the file's origin sits relative to the TCP."""
    hull_m: tuple[Position, ...] = ()
    """Corners of the convex hull in the file's frame, metres: filled in when the cell file is read; a recording keeps them."""

    @property
    def corners_m(self) -> Float64[np.ndarray, "n 3"]:
        """The hull's corners in the body's frame. Raises SettingsError when the file was never read."""
        if not self.hull_m:
            raise SettingsError(f"{self.file}: the tool's mesh was not read: load the cell from its file")
        return np.array(self.hull_m)


Body = Box | Cylinder | Mesh
Bodies = Annotated[tuple[Annotated[Body, Field(discriminator="shape")], ...], Field(min_length=1)]


def read(body: Mesh, folder: Path) -> Mesh:
    """The body with the hull of its file, which is sought in `folder`. Raises SettingsError in a sentence."""
    import open3d as o3d  # half a second, and only where a tool has a mesh

    path = folder / body.file
    if not path.is_file():
        raise SettingsError(f"{path}: there is no such file; a tool's mesh is sought beside the cell file")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        points = UNITS_M[body.unit] * np.asarray(o3d.io.read_triangle_mesh(path).vertices)
    if len(points) < 4 or not np.isfinite(points).all():
        raise SettingsError(f"{path}: not readable as a mesh: STL, OBJ and PLY are")
    longest_m = float(np.ptp(points, axis=0).max())
    if not PLAUSIBLE_M[0] <= longest_m <= PLAUSIBLE_M[1]:
        raise SettingsError(f"{path}: in {body.unit} it would be {longest_m:g} m long: is `unit` right?")
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:
        raise SettingsError(f"{path}: it is flat: a body needs a volume") from None
    # to a micrometre, in an order of its own: the same file gives the same settings
    hull = sorted({(x, y, z) for x, y, z in (np.round(corners, 6) + 0.0).tolist()})
    return body.model_copy(update={"hull_m": tuple(hull)})
