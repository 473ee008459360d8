"""What a cycle reads, what it answers (schema binpick-result/1), and the snapshot that every interface shows.

A `Result` is serialised once to bytes; REST sends those, the registers are filled from the same object. Metres, radians.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator

from binpick.calibration import RigVersion, SampleAnswer
from binpick.data import CameraStatus
from binpick.errors import Code
from binpick.message import BinMessage, CalibrationMessage, Level, PoseMessage, RecipeMessage, SyncMessage, Triple, Wire, Xyzw
from binpick.outcomes import Attempt

FrameName = Literal["camera", "bin", "base"]
Phase = Literal["starting", "ready", "acquiring", "computing", "stopping"]
Source = Literal["modbus", "rest"]
Owner = Literal["modbus", "rest", "none"]


class Request(Wire):
    """What a client asks of one cycle; 0, null and "" mean the recipe's own."""

    recipe: Annotated[int, Field(ge=0, le=65535)] = 0
    """Recipe number; 0: the first."""
    bin: Annotated[int, Field(ge=0, le=65535)] = 0
    """Bin number; 0: the recipe's."""
    tool: Annotated[int, Field(ge=0, le=65535)] = 0
    """Tool number; 0: the recipe's."""
    frame: FrameName | None = None
    """Frame of the poses; null: the recipe's."""
    max_grasps: Annotated[int, Field(ge=0, le=20)] = 0
    """Most grasps to return; 0: the recipe's."""
    pose_format: Literal["quaternion_xyzw", "rotvec_rad", "kuka_abc_deg", "fanuc_wpr_deg", "ur_rxryrz_rad"] | None = None
    """Orientation on Modbus; null: the recipe's. REST always carries the quaternion."""
    timeout_ms: Annotated[int, Field(ge=0, le=60000)] = 0
    """Time limit of the cycle, ms; 0: the cell's."""
    request_id: Annotated[str, Field(max_length=64)] = ""
    """Echoed in the result."""
    T_base_flange: PoseMessage | None = None
    """The flange when the cameras ride on it."""


class ReturnCode(Wire):
    """The cycle's outcome."""

    value: int
    name: str
    message: str

    @classmethod
    def of(cls, code: Code, message: str = "") -> "ReturnCode":
        """The code with its own sentence, or a more exact one."""
        return cls(value=code.value, name=code.name.lower(), message=message or code.message)

    @property
    def code(self) -> Code:
        """As the enum."""
        return Code(self.value)


class Sigma(Wire):
    """1-sigma uncertainty of a grasp: the true error is within it in about 7 of 10 cases, within twice of it in 19 of 20.

    From depth; of poses in `base` also from the calibration, as far as the rig file says how good it is.
    """

    xy_m: float
    """Across the approach; two fingers: along the closing direction, of the middle between both contacts."""
    z_m: float
    """Along the approach; two fingers: of the part between them."""
    tilt_rad: float
    """Between the approach and the surface's normal; two fingers: between the closing direction and the contacts."""


class ToolMessage(Wire):
    """The tool a grasp is for."""

    number: int
    name: str
    kind: str


class GraspMessage(Wire):
    """One grasp: T_frame_tcp, z into the object; the only motion checked is pregrasp -> pose -> lift (along the bin's z)."""

    id: str
    rank: int
    tool: ToolMessage
    frame: FrameName
    position_m: Triple
    quaternion_xyzw: Xyzw
    T_frame_pregrasp: PoseMessage
    approach_m: float
    lift_m: float
    open_m: float
    close_m: float
    quality: Annotated[float, Field(ge=0, le=1)]
    sigma: Sigma
    clearance_m: float
    part_id: int

    @property
    def number(self) -> int:
        """The grasp's number within its cycle, 1 and up; `id` is "<cycle>-<number>"."""
        return int(self.id.rsplit("-", 1)[1])


class PartMessage(Wire):
    """A part that the recipe's mesh was laid onto: where the mesh's frame lies, null when that is not sure.

    Of poses that look alike by the part's symmetry it is the one turned least in the bin.
    """

    id: int
    """The `part_id` of its grasps."""
    part_ids: tuple[int, ...]
    """All `part_id`s that are of this part: it may have come out in pieces."""
    label: str
    """The name of the mesh file, without its ending."""
    frame: FrameName
    score: Annotated[float, Field(ge=0, le=1)]
    """How well mesh and measurement explain each other."""
    T_frame_part: PoseMessage | None


class Funnel(Wire):
    """How many candidates each stage left, and why most of the others fell out ("" when none did)."""

    counts: dict[str, int]
    dominating: str


class Inputs(Wire):
    """What the result rests on."""

    rig_sha256: str
    settings_sha256: str
    recipe: RecipeMessage
    frame_ids: tuple[int, int]


class Result(Wire):
    """The whole answer of a cycle."""

    schema_: Annotated[Literal["binpick-result/1"], Field(alias="schema")] = "binpick-result/1"
    cycle_id: int
    request: Request
    captured_at: str | None
    age_ms: float | None = None
    simulated: bool = False
    return_code: ReturnCode
    bin: BinMessage | None
    grasps: tuple[GraspMessage, ...] = ()
    parts: tuple[PartMessage, ...] = ()
    """With a mesh: parts in the order of their grasps. They say where a part lies; only `grasps` are to be moved by."""
    funnel: Funnel | None = None
    sync: SyncMessage | None = None
    calibration: CalibrationMessage | None = None
    """What the watchdog says of the rig's calibration; null when it did not look."""
    timing_ms: dict[str, float] = Field(default_factory=dict)
    inputs: Inputs | None = None

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)

    @model_validator(mode="after")
    def _poses_need_a_code(self) -> "Result":
        if self.grasps and not self.return_code.code.carries_poses:
            raise ValueError(f"poses exist only with return codes 0 to 3, not with {self.return_code.value}")
        return self

    @property
    def stopped(self) -> dict[str, int]:
        """How many poses the last gate stopped, by its objection."""
        counts = self.funnel.counts if self.funnel is not None else {}
        return {name.removeprefix("gate_"): count for name, count in counts.items() if name.startswith("gate_")}

    def json_bytes(self) -> bytes:
        """The result as every interface and file carries it."""
        return self.model_dump_json(by_alias=True, indent=1).encode() + b"\n"

    def timeless_bytes(self) -> bytes:
        """Without times and ages: equal bytes mean an equal answer."""
        return self.model_copy(update={"timing_ms": {}, "age_ms": None, "captured_at": None}).json_bytes()


def failure(cycle_id: int, request: Request, code: Code, message: str = "", *, simulated: bool = False) -> Result:
    """The result of a cycle that never came to its scene."""
    return Result(cycle_id=cycle_id, request=request, captured_at=None, simulated=simulated,
                  return_code=ReturnCode.of(code, message), bin=None)


@dataclass(frozen=True, slots=True)
class Published:
    """A finished cycle as published: the object, its bytes, and when (monotonic ns) it was triggered; without images, ended."""

    result: Result
    body: bytes
    triggered_ns: int
    attempts: tuple[Attempt, ...] = ()
    """Its grasps as they will be remembered when their outcomes are told."""
    sample: SampleAnswer | None = None
    """What came of it when it was a calibration sample."""


@dataclass(frozen=True, slots=True)
class Artefact:
    """A picture or a cloud of a finished cycle."""

    media_type: str
    body: bytes


@dataclass(frozen=True, slots=True)
class Drift:
    """What the watchdog knows of the rig's calibration, over all cycles.

    `latest` is its last word; `row_px` the row error of the last cycles that could tell, the newest last, of which cycles
    `cycle_ids` says; the limits are the cell file's. `attention` are sentences for whoever looks after the cell, `unseen` what
    no figure here would show.
    """

    level: Level = "ok"
    latest: CalibrationMessage | None = None
    row_px: tuple[float, ...] = ()
    cycle_ids: tuple[int, ...] = ()
    warn_px: float = 0.3
    fault_px: float = 1.0
    marks: Literal["none", "to be stored", "stored"] = "none"
    attention: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything the interfaces may show, at one instant; replaced whole, never changed.

    `current` is the cycle in flight (0: none); `published` is the result that holds until it is acknowledged, withdrawn, too
    old, or replaced: `valid` says whether it does, `withdrawn` why not. `latest` is the last finished cycle in any case.
    """

    boot_id: int
    phase: Phase = "starting"
    current: int = 0
    acquired: bool = False
    published: Published | None = None
    valid: bool = False
    withdrawn: str = ""
    latest: Published | None = None
    cameras: tuple[CameraStatus, ...] = ()
    faults: tuple[str, ...] = ()
    owner: Owner = "none"
    simulated: bool = False
    counts: tuple[tuple[str, int], ...] = ()
    drift: Drift | None = None
    """What is known of the calibration's; None: nobody watches it."""
    rig: RigVersion | None = None
    """The version of the rig that the cell runs on."""
    rig_note: str = ""
    """What somebody should know of the choice of that version."""

    @property
    def rig_version(self) -> int:
        """Its number; 0: unknown."""
        return self.rig.version if self.rig is not None else 0
