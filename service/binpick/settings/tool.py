"""A tool: how it holds a part, by suction or between two fingers, and every body that must not touch anything."""

from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from binpick.settings.base import Number, Placement, Strict

OnTheTcp = Annotated[float, Field(ge=0, le=0)]


class Cup(Strict):
    """A suction cup; the TCP is the centre of its lip."""

    x_m: OnTheTcp = 0.0
    """Centre along the TCP's x, metres; 0 while a tool has one cup."""
    y_m: OnTheTcp = 0.0
    """Centre along the TCP's y, metres; 0 while a tool has one cup."""
    radius_m: Annotated[float, Field(ge=0.001, le=0.1)] = 0.007
    """Lip radius, uncompressed, metres."""


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


Body = Box | Cylinder
Bodies = Annotated[tuple[Annotated[Body, Field(discriminator="shape")], ...], Field(min_length=1)]


class Fingers(Strict):
    """Two parallel fingers: boxes from the fingertips, where the TCP's z is 0, back to the gripper's body, closing along x."""

    stroke_min_m: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Distance between the pads when closed, metres."""
    stroke_max_m: Annotated[float, Field(gt=0, le=0.5)] = 0.07
    """Distance between the pads when open, metres."""
    pad_width_m: Annotated[float, Field(ge=0.002, le=0.1)] = 0.012
    """Width of a finger, along the TCP's y, metres."""
    pad_depth_m: Annotated[float, Field(ge=0.002, le=0.2)] = 0.018
    """How far a pad reaches back from the fingertip: parts are held by it, metres."""
    thickness_m: Annotated[float, Field(ge=0.001, le=0.1)] = 0.007
    """Thickness of a finger, along the TCP's x, metres."""
    length_m: Annotated[float, Field(ge=0.005, le=0.5)] = 0.06
    """From the fingertip back to the gripper's body, metres."""

    @model_validator(mode="after")
    def _sound(self) -> "Fingers":
        if self.stroke_min_m >= self.stroke_max_m:
            raise ValueError("stroke_min_m must be below stroke_max_m")
        if self.pad_depth_m > self.length_m:
            raise ValueError("pad_depth_m must not be above length_m")
        return self


class _Mounted(Strict):
    """What every tool has; z of the TCP points into the part, so bodies lie at negative z."""

    number: Number = 1
    T_flange_tcp: Placement = Placement(position_m=(0.0, 0.0, 0.25))
    """The TCP that the robot must be given, as `binpick check` tells; poses are of the TCP and do not depend on it."""
    approach_m: Annotated[float, Field(ge=0.005, le=0.5)] = 0.08
    """Straight way from pre-grasp to grasp, metres."""
    lift_m: Annotated[float, Field(ge=0.005, le=1.0)] = 0.15
    """Straight way up after gripping, metres."""
    max_tilt_rad: Annotated[float, Field(ge=0, le=np.pi / 2)] = 0.6
    """Largest angle between the approach and straight down into the bin, radians."""


class SuctionTool(_Mounted):
    """A suction tool; the TCP is the centre of the uncompressed lip."""

    name: Annotated[str, Field(min_length=1, max_length=64)] = "suction"
    """For people."""
    kind: Literal["suction"] = "suction"
    """How it holds."""
    cups: Annotated[tuple[Cup, ...], Field(min_length=1, max_length=1)] = (Cup(),)
    """The cups."""
    bodies: Bodies = (
        Cylinder(shape="cylinder", radius_m=0.009, length_m=0.018, T_tcp_body=Placement(position_m=(0, 0, -0.011))),
        Cylinder(shape="cylinder", radius_m=0.012, length_m=0.18, T_tcp_body=Placement(position_m=(0, 0, -0.11))),
        Cylinder(shape="cylinder", radius_m=0.04, length_m=0.05, T_tcp_body=Placement(position_m=(0, 0, -0.225))),
    )
    """Everything that must not hit anything, a hand-mounted camera included."""
    compression_m: Annotated[float, Field(ge=0, le=0.02)] = 0.002
    """How far the robot's program presses beyond the pose, metres, as `binpick check` tells; poses lie on the surface."""
    compliance_m: Annotated[float, Field(ge=0.0002, le=0.01)] = 0.0012
    """How far the lip follows a surface that is not flat, metres, either way of its fitted plane."""


class TwoFingerTool(_Mounted):
    """A parallel gripper; the TCP is midway between the pads at the fingertips, x along the closing direction."""

    name: Annotated[str, Field(min_length=1, max_length=64)] = "two fingers"
    """For people."""
    kind: Literal["two_finger"]
    """How it holds."""
    T_flange_tcp: Placement = Placement(position_m=(0.0, 0.0, 0.19))
    """The TCP that the robot must be given, as `binpick check` tells; poses are of the TCP and do not depend on it."""
    fingers: Fingers = Fingers()
    """The fingers."""
    bodies: Bodies = (
        Box(shape="box", size_m=(0.11, 0.05, 0.07), T_tcp_body=Placement(position_m=(0, 0, -0.095))),
        Cylinder(shape="cylinder", radius_m=0.04, length_m=0.06, T_tcp_body=Placement(position_m=(0, 0, -0.16))),
    )
    """Everything but the fingers that must not hit anything, a hand-mounted camera included."""


def _kind(tool: Any) -> Any:
    """A tool whose kind is not given is a suction tool."""
    return tool.get("kind", "suction") if isinstance(tool, dict) else getattr(tool, "kind", None)


Tool: TypeAlias = Annotated[
    Annotated[SuctionTool, Tag("suction")] | Annotated[TwoFingerTool, Tag("two_finger")],
    Discriminator(_kind, custom_error_type="kind", custom_error_message="a tool's kind is suction or two_finger")]
