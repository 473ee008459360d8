"""The whole cell: bins, tools, recipes, cameras, who controls it, where it publishes."""

import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from binpick.settings.base import Strict
from binpick.settings.recipe import Bin, Recipe
from binpick.settings.tool import SuctionTool, Tool

Port = Annotated[int, Field(ge=1, le=65535)]
PixelFormat = Literal["Mono8", "Mono10", "Mono10p", "Mono12", "Mono12p", "Mono12Packed", "BayerRG8"]
Sync = Literal["line", "scheduled_action", "action", "software"]
MarkFamily = Literal["apriltag_36h11", "apriltag_25h9", "apriltag_16h5", "4x4_50", "5x5_50", "6x6_50"]


class CameraAddress(Strict):
    """One GigE Vision camera."""

    address: str = ""
    """IPv4 address; opened without discovery."""
    serial: str = ""
    """Serial number, checked when given, searched when there is no address."""

    @model_validator(mode="after")
    def _given(self) -> "CameraAddress":
        if not self.address and not self.serial:
            raise ValueError("give the camera's address, its serial number, or both")
        return self


class SyncLines(Strict):
    """The wire of `sync: line`, in the cameras' own names; Line2 is left for the projector."""

    output: Literal["Line0", "Line1"] = "Line1"
    """The first camera's line that is high while it exposes."""
    input: Literal["Line0", "Line1", "Line3"] = "Line0"
    """The line of every other camera that it is wired to."""


class AravisCameras(Strict):
    """Two to five GigE Vision cameras driven by Aravis; depth is made from the first two."""

    backend: Literal["aravis"] = "aravis"
    left: CameraAddress = CameraAddress(address="169.254.1.2")
    """The rig's first camera."""
    right: CameraAddress = CameraAddress(address="169.254.2.2")
    """The rig's second camera."""
    more: Annotated[tuple[CameraAddress, ...], Field(max_length=3)] = ()
    """The rig's third, fourth and fifth camera: triggered with the others, and part of what is proved of a pair."""
    sync: Sync = "software"
    """How they are triggered. line: the first camera's exposure triggers the others by a wire; scheduled_action: one datagram
    names a time of their PTP clock; action: one datagram, at once; software: one trigger each, 0.1 to 0.5 ms apart."""
    lines: SyncLines = SyncLines()
    """The wire of `sync: line`."""
    max_skew_us: Annotated[float, Field(gt=0, le=1_000_000)] = 5000.0
    """A pair that may be further apart, at 3 sigma of what proves its skew, is refused, µs."""
    pixel_format: PixelFormat = "Mono8"
    """What the cameras send; everything is turned into 8-bit grey."""
    packet_size: Literal["auto"] | Annotated[int, Field(ge=576, le=16000)] = "auto"
    """GVSP packet size with its IP header, bytes; not above the network's MTU. auto: the largest that arrives."""
    heartbeat_ms: Annotated[int, Field(ge=1500, le=60000)] = 3000
    """After this silence a camera frees itself of its controller, ms."""


class FileCameras(Strict):
    """Images from disk instead of cameras: every cycle sees the same pair."""

    backend: Literal["files"]
    left: Path
    """The left image."""
    right: Path
    """The right image."""
    max_skew_us: ClassVar[float] = math.inf
    """Not a key of the file: images from disk have no skew."""


class RestSettings(Strict):
    """The REST server and the page at /ui."""

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all."""
    port: Port = 8080
    """TCP port."""


class ModbusSettings(Strict):
    """The Modbus/TCP server."""

    host: str = "0.0.0.0"
    """Address to listen on."""
    port: Port = 502
    """TCP port."""
    word_order: Literal["ABCD", "CDAB"] = "ABCD"
    """Order of the two words of a 32-bit value."""


class Publish(Strict):
    """Where results go."""

    rest: RestSettings = RestSettings()
    """REST."""
    modbus: ModbusSettings | None = ModbusSettings()
    """Modbus/TCP; null: none."""


class Recording(Strict):
    """Keeps cycles on disk."""

    directory: Path | None = None
    """Every cycle's input and result are stored below this folder; null: none. A relative one starts where the daemon does."""


class MemorySettings(Strict):
    """Remembers across restarts which grasps failed."""

    directory: Path | None = None
    """Kept as memory.json in this folder; null: lost with the process. A relative one starts where the daemon does."""


class CalibrationSettings(Strict):
    """Where the daemon keeps what calibrating it makes, and the board it looks for."""

    directory: Path | None = None
    """Versions of the rig, samples of a board and what the watchdog finds are kept below this folder; null: in `calibration`
    beside the rig file. A relative one starts where the daemon does."""
    board: Annotated[str, Field(max_length=64)] = ""
    """The board of samples that name none, as `charuco:9x6:0.025`; "": the one that the rig was calibrated with."""


class Watchdog(Strict):
    """Looks at every cycle's images whether the cameras still stand to each other as they were calibrated."""

    warn_px: Annotated[float, Field(ge=0.1, le=5)] = 0.3
    """Rows of the two images this far apart, px: grasps come with return code 2, calibration warning."""
    fault_px: Annotated[float, Field(ge=0.2, le=8)] = 1.0
    """Rows this far apart, px: no grasps any more, return code -24."""
    self_correct: bool = False
    """Small turns of the second camera that rows and marks prove are taken out of the following cycles' depth; they keep return
    code 2, and every result says so."""

    @model_validator(mode="after")
    def _in_order(self) -> "Watchdog":
        if self.fault_px <= self.warn_px:
            raise ValueError(f"fault_px is {self.fault_px:g}: it must be above warn_px, {self.warn_px:g}")
        return self


class ReferenceMarks(Strict):
    """ArUco or AprilTag marks fixed to the cell, seen by both cameras; `POST /v1/calibration/verify` stores where they are."""

    family: MarkFamily = "apriltag_36h11"
    """What is printed."""
    ids: Annotated[tuple[Annotated[int, Field(ge=0, le=1023)], ...], Field(max_length=64)] = ()
    """The marks' numbers; empty: whatever is seen when they are stored, three or more."""

    @model_validator(mode="after")
    def _enough(self) -> "ReferenceMarks":
        if self.ids and len(set(self.ids)) < 3:
            raise ValueError("ids: three different marks at least, or leave it empty")
        return self


class Cell(Strict):
    """One robot cell. Only `bins` (or `bin`) is required."""

    bins: Annotated[tuple[Bin, ...], Field(min_length=1)]
    """The load carriers."""
    tools: Annotated[tuple[Tool, ...], Field(min_length=1)] = (SuctionTool(),)
    """The tools; also `gripper:` for a single one."""
    recipes: Annotated[tuple[Recipe, ...], Field(min_length=1)] = (Recipe(),)
    """The recipes; the first is the default."""
    rig: Path = Path("rig.json")
    """The rig file, relative to the cell file."""
    cameras: Annotated[AravisCameras | FileCameras, Field(discriminator="backend")] = AravisCameras()
    """The cameras."""
    control: Literal["modbus", "rest", "none"] = "modbus"
    """The one interface that may start cycles."""
    publish: Publish = Publish()
    """Servers."""
    recording: Recording = Recording()
    """What is kept."""
    memory: MemorySettings = MemorySettings()
    """The memory of outcomes."""
    calibration: CalibrationSettings = CalibrationSettings()
    """Versions of the rig, and samples to calibrate from."""
    watchdog: Watchdog = Watchdog()
    """What is made of a calibration that drifts."""
    reference_marks: ReferenceMarks | None = None
    """Marks fixed to the cell: they show what rows cannot, a turn about the vertical and a mount that was pushed. null: none.
    Where they are is kept in `calibration.directory`."""
    timeout_ms: Annotated[int, Field(ge=100, le=60000)] = 5000
    """Time limit of a cycle when the request names none, ms."""
    result_max_age_ms: Annotated[int, Field(ge=500, le=3_600_000)] = 60000
    """A result unread for longer than this is withdrawn, ms."""
    reconnect_s: Annotated[float, Field(ge=0.1, le=60)] = 2.0
    """A controller's connection lost for longer than this withdraws its result, seconds."""

    @property
    def calibration_directory(self) -> Path:
        """Where versions of the rig and samples are kept."""
        return self.calibration.directory or self.rig.parent / "calibration"

    @model_validator(mode="before")
    @classmethod
    def _singles(cls, document: Any) -> Any:
        """A single `bin:` or `gripper:` is number 1."""
        if not isinstance(document, dict):
            return document
        document = dict(document)
        for single, several in (("bin", "bins"), ("gripper", "tools")):
            if single in document:
                if several in document:
                    raise ValueError(f"give {single} or {several}, not both")
                document[several] = [document.pop(single)]
        return document

    @model_validator(mode="after")
    def _consistent(self) -> "Cell":
        for kind in ("bins", "tools", "recipes"):
            numbers = [item.number for item in getattr(self, kind)]
            if len(set(numbers)) != len(numbers):
                raise ValueError(f"{kind}: every number may stand once, got {numbers}")
        bins, tools = {b.number for b in self.bins}, {t.number for t in self.tools}
        for recipe in self.recipes:
            if recipe.bin is not None and recipe.bin not in bins:
                raise ValueError(f"recipe {recipe.number}: there is no bin {recipe.bin}")
            if missing := set(recipe.tools) - tools:
                raise ValueError(f"recipe {recipe.number}: there is no tool {sorted(missing)}")
            own = set(recipe.tools) or {self.tools[0].number}
            if recipe.mesh is not None and (strange := {grasp.tool for grasp in recipe.mesh.grasps} - own):
                raise ValueError(f"recipe {recipe.number}: mesh.grasps are for tool {sorted(strange)}, the recipe's are "
                                 f"{sorted(own)}")
            if len(recipe.lights) > 1 and self.cameras.backend == "files":
                raise ValueError(f"recipe {recipe.number}: two images from disk are one shot, not {len(recipe.lights)}")
            if recipe.metered and self.cameras.backend == "files":
                raise ValueError(f"recipe {recipe.number}: exposure_us: auto needs cameras, not images from disk")
        if self.control == "modbus" and self.publish.modbus is None:
            raise ValueError("control is modbus, but publish.modbus is null")
        return self
