"""A tool: what touches the part, and every body that must not touch anything."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

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


class Tool(Strict):
    """A suction tool; z of the TCP points out of the lips, into the part, so bodies lie at negative z."""

    number: Number = 1
    name: Annotated[str, Field(min_length=1, max_length=64)] = "suction"
    """For people."""
    kind: Literal["suction"] = "suction"
    """How it holds."""
    T_flange_tcp: Placement = Placement(position_m=(0.0, 0.0, 0.25))
    """The TCP that the robot must be given, as `binpick check` tells; poses are of the TCP and do not depend on it."""
    cups: Annotated[tuple[Cup, ...], Field(min_length=1, max_length=1)] = (Cup(),)
    """The cups."""
    bodies: Annotated[tuple[Annotated[Body, Field(discriminator="shape")], ...], Field(min_length=1)] = (
        Cylinder(shape="cylinder", radius_m=0.009, length_m=0.018, T_tcp_body=Placement(position_m=(0, 0, -0.011))),
        Cylinder(shape="cylinder", radius_m=0.012, length_m=0.18, T_tcp_body=Placement(position_m=(0, 0, -0.11))),
        Cylinder(shape="cylinder", radius_m=0.04, length_m=0.05, T_tcp_body=Placement(position_m=(0, 0, -0.225))),
    )
    """Everything that must not hit anything, a hand-mounted camera included."""
    approach_m: Annotated[float, Field(ge=0.005, le=0.5)] = 0.08
    """Straight way from pre-grasp to grasp, metres."""
    lift_m: Annotated[float, Field(ge=0.005, le=1.0)] = 0.15
    """Straight way up after gripping, metres."""
    compression_m: Annotated[float, Field(ge=0, le=0.02)] = 0.002
    """How far the robot's program presses beyond the pose, metres, as `binpick check` tells; poses lie on the surface."""
    compliance_m: Annotated[float, Field(ge=0.0002, le=0.01)] = 0.0012
    """How far the lip follows a surface that is not flat, metres, either way of its fitted plane."""
    max_tilt_rad: Annotated[float, Field(ge=0, le=np.pi / 2)] = 0.6
    """Largest angle between the approach and straight down into the bin, radians."""
