"""The rig file: what the calibration tool writes and the daemon runs on (format "binpick-rig", version 1)."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_serializer, model_validator

from binpick import geometry
from binpick.errors import RigError
from binpick.geometry import Transform

Row3 = Annotated[tuple[float, float, float], Field()]
Row4 = tuple[float, float, float, float]
Matrix3 = tuple[Row3, Row3, Row3]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


class Part(BaseModel):
    """Base of the file's models: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RigCamera(Part):
    """One camera of the rig: OpenCV's pinhole model with k1, k2, p1, p2, k3, ... for pixels of the full image."""

    name: str
    serial: str = ""
    K: Matrix3
    distortion: tuple[float, ...] = Field(min_length=4, max_length=14)
    T_cam_rig: Matrix4

    @property
    def K_px(self) -> Float[np.ndarray, "3 3"]:
        """The camera matrix in pixels."""
        return np.array(self.K)

    @property
    def distortion_coefficients(self) -> Float[np.ndarray, "n"]:
        """Distortion in OpenCV's order."""
        return np.array(self.distortion)

    @property
    def T_camera_rig(self) -> Transform:
        """Maps rig (first camera) coordinates to this camera's, metres."""
        return np.array(self.T_cam_rig)


class Quality(Part):
    """How well the calibration fits: residuals in px, and which views were not used and why.

    `hand_eye_rms_m` and `hand_eye_rms_rad`: how well T_base_rig or T_flange_rig agree with the robot, absent if never measured.
    `distortion_model`: the terms there was evidence for. `sigma`: one standard deviation of the parameters, by name and unit,
    from the scatter of the corners and of the views: what every view has wrong in common (a wrong scale) is not in it.
    """

    rms_px: float
    row_error_px: float
    hand_eye_rms_m: Annotated[float, Field(ge=0)] | None = None
    hand_eye_rms_rad: Annotated[float, Field(ge=0)] | None = None
    distortion_model: str | None = None
    sigma: dict[str, float] | None = None
    per_view_px: dict[str, float] = {}
    rejected: dict[str, str] = {}

    @model_serializer(mode="wrap")
    def _without_absent(self, handler: Callable[["Quality"], dict[str, Any]]) -> dict[str, Any]:
        """What a file does not say stays out of its checksum."""
        return {key: value for key, value in handler(self).items() if value is not None}


class Rig(Part):
    """Two or more cameras in one frame; the first camera is that frame. At most one hand-eye transform is given."""

    format: Literal["binpick-rig"] = "binpick-rig"
    version: Literal[1] = 1
    image_size_px: tuple[int, int]
    cameras: tuple[RigCamera, ...] = Field(min_length=2)
    T_base_rig: Matrix4 | None = None
    T_flange_rig: Matrix4 | None = None
    quality: Quality | None = None
    board: str | None = None
    created: str | None = None

    @model_validator(mode="after")
    def _sound(self) -> "Rig":
        if self.T_base_rig is not None and self.T_flange_rig is not None:
            raise ValueError("give T_base_rig or T_flange_rig, not both")
        named = {f"cameras.{c.name}.T_cam_rig": c.T_camera_rig for c in self.cameras}
        named |= {k: np.array(v) for k, v in (("T_base_rig", self.T_base_rig), ("T_flange_rig", self.T_flange_rig))
                  if v is not None}
        for name, T in named.items():
            if not geometry.is_rigid(T, 1e-4):
                raise ValueError(f"{name} is not a rigid transform (rotation not orthonormal, or not finite)")
        if not np.allclose(self.cameras[0].T_camera_rig, np.eye(4), atol=1e-9):
            raise ValueError("the first camera is the rig frame: its T_cam_rig must be the identity")
        return self

    @property
    def sha256(self) -> str:
        """The checksum the file carries: of everything else as canonical JSON."""
        return digest(self.model_dump(mode="json"))


def digest(document: dict[str, Any]) -> str:
    """SHA-256 of a JSON object without its own `sha256`, keys sorted, no spaces."""
    rest = {k: v for k, v in document.items() if k != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def load(path: Path) -> tuple[Rig, list[str]]:
    """The rig of a file and the warnings to show. Raises RigError with what to do."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RigError(f"{path}: there is no such rig file; make one with `binpick-calib solve`") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RigError(f"{path}: not readable as JSON: {error}") from error
    if not isinstance(document, dict) or document.get("format") != "binpick-rig":
        raise RigError(f'{path}: not a rig file: "format" must be "binpick-rig"')
    if document.get("version") != 1:
        raise RigError(f"{path}: rig file version {document.get('version')!r}; this program reads version 1")
    return _check(path, document)


def _check(path: Path, document: dict[str, Any]) -> tuple[Rig, list[str]]:
    warnings = []
    stated = document.pop("sha256", None)
    if stated is None:
        warnings.append(f"{path}: has no sha256: a hand-written rig file is used as it is")
    elif stated != digest(document):
        raise RigError(f"{path}: its sha256 does not match its content: the file was edited or damaged; "
                       "restore it, or delete the sha256 entry to use it as hand-written")
    try:
        return Rig.model_validate(document), warnings
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise RigError(f"{path}: {where or 'rig'}: {first['msg']}") from error


def dump(rig: Rig) -> bytes:
    """The file's bytes, checksum included."""
    document = rig.model_dump(mode="json")
    return (json.dumps(document | {"sha256": digest(document)}, indent=1) + "\n").encode()
