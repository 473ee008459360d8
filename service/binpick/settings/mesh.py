"""The part's CAD model: a mesh file, its unit and symmetry, and grasps taught in its frame."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from binpick.settings.base import Number, Placement, Strict

Opening = Annotated[float, Field(ge=0, le=0.5)]


class Axis(Strict):
    """An axis of symmetry through the middle of the part's surface."""

    axis: tuple[float, float, float]
    """Its direction in the mesh's frame, of any length but 0."""
    fold: Annotated[int, Field(ge=0, le=24)]
    """Into how many equal turns a full turn divides; 0: the part is round, every angle looks alike."""

    @model_validator(mode="after")
    def _has_a_direction(self) -> "Axis":
        if not any(self.axis):
            raise ValueError("axis must not be [0, 0, 0]")
        return self


class TaughtGrasp(Strict):
    """A grasp in the part's frame: every part whose pose is found, and every way it looks alike, is offered it."""

    tool: Number
    """The tool it is for."""
    T_part_tcp: Placement
    """The TCP in the mesh's frame, in metres whatever the mesh's unit: z into the part."""
    open_m: Opening = 0.0
    """Distance between the pads on the way in, metres; 0 for suction."""
    close_m: Opening = 0.0
    """Distance between the pads when they hold, metres; 0 for suction."""

    @model_validator(mode="after")
    def _closes(self) -> "TaughtGrasp":
        if self.close_m > self.open_m:
            raise ValueError("close_m must not be above open_m")
        return self


class Mesh(Strict):
    """The part as designed: each part of the bin gets its 6-D pose."""

    file: Path
    """STL, OBJ, PLY, OFF or GLTF, relative to the cell file; closed: every edge borders two triangles."""
    unit: Literal["m", "mm"]
    """What its numbers are: most CAD systems export mm."""
    symmetry: Annotated[tuple[Axis, ...], Field(max_length=3)] | None = None
    """Its axes of symmetry; absent: found from the mesh; []: none, though it may look alike (a mark tells)."""
    poses: Annotated[int, Field(ge=1, le=100)] = 8
    """For how many parts a pose is looked for, in the order of their grasps: each costs about a tenth of a second."""
    grasps: Annotated[tuple[TaughtGrasp, ...], Field(max_length=64)] = ()
    """Grasps beside those that are found without the mesh."""
