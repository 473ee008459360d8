"""A tool: how it holds a part, by suction or between two fingers, and every body that must not touch anything."""

from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from binpick.settings.base import Number, Placement, Strict
from binpick.settings.shape import Bodies, Box, Cylinder

Beside = Annotated[float, Field(ge=-0.5, le=0.5)]
Angle = Annotated[float, Field(ge=-2 * np.pi, le=2 * np.pi)]


class Cup(Strict):
    """A suction cup; its lip lies in the TCP's x-y plane."""

    x_m: Beside = 0.0
    """Centre along the TCP's x, metres; 0 for a single cup."""
    y_m: Beside = 0.0
    """Centre along the TCP's y, metres; 0 for a single cup."""
    radius_m: Annotated[float, Field(ge=0.001, le=0.1)] = 0.007
    """Lip radius, uncompressed, metres."""


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


class Wrist(Strict):
    """How the tool may be turned about its approach."""

    symmetry: Annotated[int, Field(ge=1, le=36)] = 1
    """So many turns of equal angle make a full one, and after each the tool grips the same; 1: there is only one way."""
    limits_rad: tuple[Angle, Angle] = (-np.pi, np.pi)
    """Where the TCP's x may point as seen from above, lowest and highest angle from the bin's x, counterclockwise, radians."""

    @model_validator(mode="after")
    def _sound(self) -> "Wrist":
        if self.limits_rad[0] >= self.limits_rad[1]:
            raise ValueError("limits_rad: the first must be below the second")
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
    wrist: Wrist = Wrist()
    """Other ways to hold the same: tried when the first would collide, or is out of the wrist's limits."""


class SuctionTool(_Mounted):
    """A suction tool; the TCP is the centre of the uncompressed lip, or the middle of several in one plane."""

    name: Annotated[str, Field(min_length=1, max_length=64)] = "suction"
    """For people."""
    kind: Literal["suction"] = "suction"
    """How it holds."""
    cups: Annotated[tuple[Cup, ...], Field(min_length=1, max_length=16)] = (Cup(),)
    """The cups: all must seal on one part. Several are laid along the part's longest extent by the TCP's x, or square to it."""
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

    @model_validator(mode="after")
    def _sound(self) -> "SuctionTool":
        at = np.array([(cup.x_m, cup.y_m) for cup in self.cups])
        if np.abs(at.mean(axis=0)).max() > 1e-4:
            raise ValueError("cups: the TCP must be the middle of the cups' centres (a single cup: x_m and y_m 0)")
        radii = np.array([cup.radius_m for cup in self.cups])
        apart = np.linalg.norm(at[:, None] - at, axis=2)
        if (apart < radii[:, None] + radii)[np.triu_indices(len(at), 1)].any():
            raise ValueError("cups: no two may overlap")
        turn = 2 * np.pi / self.wrist.symmetry
        turned = at @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        same = np.linalg.norm(turned[:, None] - at, axis=2) + np.abs(radii[:, None] - radii) < 1e-4
        if not same.any(axis=1).all():
            raise ValueError(f"wrist.symmetry: the cups do not lie where others lay after 1/{self.wrist.symmetry} of a turn")
        return self


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
    wrist: Wrist = Wrist(symmetry=2)
    """Half a turn is the same grip: tried when the first would collide, or is out of the wrist's limits."""
    bodies: Bodies = (
        Box(shape="box", size_m=(0.11, 0.05, 0.07), T_tcp_body=Placement(position_m=(0, 0, -0.095))),
        Cylinder(shape="cylinder", radius_m=0.04, length_m=0.06, T_tcp_body=Placement(position_m=(0, 0, -0.16))),
    )
    """Everything but the fingers that must not hit anything, a hand-mounted camera included."""

    @model_validator(mode="after")
    def _sound(self) -> "TwoFingerTool":
        if self.wrist.symmetry > 2:
            raise ValueError("wrist.symmetry: two fingers hold the same after half a turn (2), or not at all (1)")
        return self


def _kind(tool: Any) -> Any:
    """A tool whose kind is not given is a suction tool."""
    return tool.get("kind", "suction") if isinstance(tool, dict) else getattr(tool, "kind", None)


Tool: TypeAlias = Annotated[
    Annotated[SuctionTool, Tag("suction")] | Annotated[TwoFingerTool, Tag("two_finger")],
    Discriminator(_kind, custom_error_type="kind", custom_error_message="a tool's kind is suction or two_finger")]
