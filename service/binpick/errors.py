"""Every fault has one named place, one code, one HTTP status and one sentence that says what to do.

BinpickError
├── InputError            bad argument, file or setting          −1    422   exit 2
│   ├── ImageError        an image that cannot be used           −1    422   exit 2
│   ├── RigError          a rig file that cannot be used         −1    422   exit 2
│   └── SettingsError     a cell file that cannot be used        −1    422   exit 2
├── UnknownItem           no such recipe, bin or tool           −22    404   exit 2
├── FlangePoseMissing     the rig rides on the flange           −20    422   exit 2
├── FrameUnavailable      no hand-eye: never a silent fall-back −21    422   exit 2
├── PortInUse             another program listens there         −11    503   exit 2
├── CycleRefused
│   ├── Busy              one cycle at a time, never a queue    −12    409   exit 1
│   ├── NotInControl      another interface owns the cell       −23    409   exit 1
│   ├── NotReady          starting, stopping or faulted         −11    503   exit 1
│   └── NotApplicable     nothing there to do it to              −8    409   exit 1
├── CycleTimeout          the cycle's deadline passed            −3    504   exit 1
├── CycleAborted          somebody withdrew the cycle           −26    409   exit 1
└── CameraError           a camera, or the pair                  −4    503   exit 3
    ├── CameraNotFound    nothing answers at that address        −4    503   exit 3
    ├── CameraHeld        another program controls it            −4    503   exit 3
    ├── CameraLost        it answered once, and stopped          −4    503   exit 3
    └── PairRefused       two images, but not of one instant     −4    503   exit 3

Bad scenes (`Code` 100 to 110) are results, never exceptions.
"""

from enum import IntEnum


class Code(IntEnum):
    """Return codes of a cycle. Poses exist only with 0 to 3; 100 and up: the scene says no; below 0: it failed."""

    OK = 0
    TRUNCATED = 1
    CALIBRATION_WARNING = 2
    OVERFILLED = 3
    BIN_NOT_FOUND = 100
    NOTHING_GRASPABLE = 101
    BIN_EMPTY = 102
    ALL_COLLIDE = 103
    ALL_BLOCKED_BY_HISTORY = 104
    NO_DEPTH = 105
    BIN_MISMATCH = 106
    BIN_UNKNOWN = 107
    ALL_UNCERTAIN = 108
    ALL_OUT_OF_REACH = 109
    BOARD_NOT_FOUND = 110
    BAD_ARGUMENT = -1
    TIMEOUT = -3
    CAMERAS = -4
    NOT_APPLICABLE = -8
    NOT_READY = -11
    BUSY = -12
    NO_FLANGE_POSE = -20
    FRAME_UNAVAILABLE = -21
    UNKNOWN_ITEM = -22
    NOT_IN_CONTROL = -23
    CALIBRATION_FAULT = -24
    ROBOT_NOT_CLEAR = -25
    ABORTED = -26

    @property
    def carries_poses(self) -> bool:
        """True for the codes with which poses may leave the house."""
        return 0 <= self.value <= 3

    @property
    def message(self) -> str:
        """One sentence for the operator."""
        return MESSAGES[self]


MESSAGES: dict[Code, str] = {
    Code.OK: "Grasps found.",
    Code.TRUNCATED: "Grasps found; time ran out before all candidates were checked.",
    Code.CALIBRATION_WARNING: "Grasps found; the calibration has drifted: verify it soon.",
    Code.OVERFILLED: "Grasps found; parts reach above the rim of the bin.",
    Code.BIN_NOT_FOUND: "The bin was not found: check that it stands where the cell file says.",
    Code.NOTHING_GRASPABLE: "Parts are there, but no surface fits the tool.",
    Code.BIN_EMPTY: "The bin is empty: its floor was seen and nothing lies on it.",
    Code.ALL_COLLIDE: "Every grasp would hit the bin, a part, or something not seen.",
    Code.ALL_BLOCKED_BY_HISTORY: "Every grasp left has failed here before: stir the bin, try another tool, or "
                                 "exchange the bin and say so (command 8).",
    Code.NO_DEPTH: "Too few pixels could be measured: check light, projector and lens.",
    Code.BIN_MISMATCH: "What stands there does not match the bin's model.",
    Code.BIN_UNKNOWN: "Nothing was found, but too little of the floor was seen to call the bin empty.",
    Code.ALL_UNCERTAIN: "Every grasp is less certain than the recipe allows.",
    Code.ALL_OUT_OF_REACH: "Every grasp was stopped by the last gate: out of reach, tilted too far, or not sound.",
    Code.BOARD_NOT_FOUND: "The board was not seen by every camera: the sample says by which, and why not.",
    Code.BAD_ARGUMENT: "An argument is missing or out of range.",
    Code.TIMEOUT: "The cycle did not end within its time limit.",
    Code.CAMERAS: "The cameras delivered no usable pair.",
    Code.NOT_APPLICABLE: "There is nothing to apply this command to.",
    Code.NOT_READY: "The cell is not ready: see its health.",
    Code.BUSY: "A cycle is running; nothing is queued: trigger again when READY is set.",
    Code.NO_FLANGE_POSE: "The cameras ride on the flange and no valid flange pose was sent.",
    Code.FRAME_UNAVAILABLE: "The rig has no hand-eye calibration: poses in the robot's base do not exist.",
    Code.UNKNOWN_ITEM: "There is no recipe, bin or tool of that number.",
    Code.NOT_IN_CONTROL: "Another interface controls this cell.",
    Code.CALIBRATION_FAULT: "The calibration has drifted too far to be trusted: calibrate again.",
    Code.ROBOT_NOT_CLEAR: "The robot is not reported clear of the cameras' view.",
    Code.ABORTED: "The cycle was withdrawn before it ended.",
}


class BinpickError(Exception):
    """Root of every fault; the text is one sentence for the user."""

    code: Code = Code.BAD_ARGUMENT
    http_status: int = 422
    exit_code: int = 2


class InputError(BinpickError):
    """A bad argument, file or setting."""


class ImageError(InputError):
    """An image that cannot be used."""


class RigError(InputError):
    """A rig file that cannot be used."""


class SettingsError(InputError):
    """A cell file that cannot be used."""


class UnknownItem(BinpickError):
    """No recipe, bin or tool of that number."""

    code, http_status = Code.UNKNOWN_ITEM, 404


class FlangePoseMissing(BinpickError):
    """The rig rides on the flange and no valid flange pose came with the request."""

    code = Code.NO_FLANGE_POSE


class FrameUnavailable(BinpickError):
    """Poses in that frame do not exist for this rig."""

    code = Code.FRAME_UNAVAILABLE


class PortInUse(BinpickError):
    """Another program listens on a port this daemon should serve."""

    code, http_status = Code.NOT_READY, 503


class CycleRefused(BinpickError):
    """A cycle that was not started; the cell's state is unchanged."""

    http_status, exit_code = 409, 1


class Busy(CycleRefused):
    """One cycle at a time; nothing is queued."""

    code = Code.BUSY


class NotInControl(CycleRefused):
    """Another interface owns the cell."""

    code = Code.NOT_IN_CONTROL


class NotReady(CycleRefused):
    """The cell is starting, stopping or faulted."""

    code, http_status = Code.NOT_READY, 503


class NotApplicable(CycleRefused):
    """There is nothing to apply the command to."""

    code = Code.NOT_APPLICABLE


class CycleTimeout(BinpickError):
    """The deadline of the cycle passed."""

    code, http_status, exit_code = Code.TIMEOUT, 504, 1


class CycleAborted(BinpickError):
    """The cycle was withdrawn."""

    code, http_status, exit_code = Code.ABORTED, 409, 1


class CameraError(BinpickError):
    """A camera, or the pair, failed; `camera` names which ("left", "right", or "" for the pair)."""

    code, http_status, exit_code = Code.CAMERAS, 503, 3

    def __init__(self, message: str, camera: str = "") -> None:
        super().__init__(message)
        self.camera = camera


class CameraNotFound(CameraError):
    """Nothing answers at that address."""


class CameraHeld(CameraError):
    """Another program controls the camera."""


class CameraLost(CameraError):
    """The camera answered once and stopped."""


class PairRefused(CameraError):
    """Two images came, but not of one instant, or not whole."""
