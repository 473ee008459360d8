"""A stereo network from an .onnx file: two images in, one disparity map out, on the CPU.

The contract of a model: two float32 inputs, left then right, [1, C, H, W] with C 1 or 3, grey levels 0 to 255 (repeated three
times for C 3; a model that wants them normalised does so in its own first layers); one float32 output, [1, 1, H, W] or
[1, H, W], disparity of the left view in px of the input, positive; NaN or a negative number where it measures nothing. H and
W may be dynamic: the images are then padded at the right and the bottom to a multiple of 32 px; or fixed: padded to that size.
"""

import functools
import importlib
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from binpick.data import Disparity, Image
from binpick.errors import InputError

MULTIPLE_PX = 32
"""What stereo networks with a dynamic size divide it by, at most (five halvings)."""
Tensor = Float32[np.ndarray, "1 channels padded_h padded_w"]


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """A loaded model; a side of None is dynamic."""

    session: Any
    faults: tuple[type[Exception], ...]
    inputs: tuple[str, str]
    channels: int
    height: int | None
    width: int | None


def disparity(left: Image, right: Image, model: Path) -> Disparity:
    """What the model says about the left view, px, NaN where it says nothing, of the images' shape. Raises InputError."""
    loaded = load(model)
    rows, cols = left.shape
    size = _size(rows, loaded.height), _size(cols, loaded.width)
    if size[0] < rows or size[1] < cols:
        raise InputError(f"{model}: takes images of {size[1]}x{size[0]} px, but the window with its search margin is "
                         f"{cols}x{rows} px: export the model with dynamic or larger height and width")
    tensors = [_tensor(image, size, loaded.channels) for image in (left, right)]
    try:
        outputs = loaded.session.run(None, dict(zip(loaded.inputs, tensors, strict=True)))
    except loaded.faults as error:
        raise InputError(f"{model}: fails on images of {size[1]}x{size[0]} px: {_first_line(error)}") from error
    return _disparity(outputs[0], size, model)[:rows, :cols]


def load(model: Path) -> Network:
    """The model of a file, loaded once until the file changes. Raises InputError with what to do."""
    try:
        stat = model.stat()
    except OSError as error:
        raise InputError(f"{model}: there is no such model: {error.strerror}") from error
    return _load(model, (stat.st_mtime_ns, stat.st_size), cv2.getNumThreads())


@functools.lru_cache(maxsize=2)
def _load(model: Path, _version: tuple[int, int], threads: int) -> Network:
    runtime = _runtime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    # idle threads that spin would take the other stages' cores
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    faults = _faults(runtime)
    try:
        session = runtime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    except faults as error:
        raise InputError(f"{model}: not a model that can be run: {_first_line(error)}") from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 2 or len(outputs) != 1:
        raise InputError(f"{model}: has {len(inputs)} inputs and {len(outputs)} outputs; a stereo model here has two images "
                         "in, left and right, and one disparity map out")
    shapes = [_input_shape(value, model) for value in inputs]
    if shapes[0] != shapes[1]:
        raise InputError(f"{model}: its two inputs differ: {shapes[0]} and {shapes[1]}")
    channels, height, width = shapes[0]
    return Network(session, faults, (inputs[0].name, inputs[1].name), channels, height, width)


def _runtime() -> types.ModuleType:
    """onnxruntime, an extra: imported when a model is used."""
    try:
        return importlib.import_module("onnxruntime")
    except ImportError as error:
        raise InputError("the matcher onnx needs onnxruntime: pip install 'binpick[onnx]'") from error


def _input_shape(value: Any, model: Path) -> tuple[int, int | None, int | None]:
    """Channels, height and width of one input; None: dynamic."""
    shape = [side if isinstance(side, int) and side > 0 else None for side in value.shape]
    if value.type != "tensor(float)" or len(shape) != 4 or shape[0] not in (1, None) or shape[1] not in (1, 3):
        raise InputError(f"{model}: input {value.name!r} is {value.type} {value.shape}; it must be float32 [1, 1 or 3, H, W]")
    return int(shape[1] or 1), shape[2], shape[3]


def _size(side: int, fixed: int | None) -> int:
    return fixed if fixed is not None else MULTIPLE_PX * -(-side // MULTIPLE_PX)


def _tensor(image: Image, size: tuple[int, int], channels: int) -> Tensor:
    rows, cols = image.shape
    padded = cv2.copyMakeBorder(image, 0, size[0] - rows, 0, size[1] - cols, cv2.BORDER_REPLICATE).astype(np.float32)
    return np.ascontiguousarray(np.broadcast_to(padded, (1, channels, *size)))


def _disparity(output: Any, size: tuple[int, int], model: Path) -> Disparity:
    """The map of an output, NaN where the model gave no sound number."""
    if not isinstance(output, np.ndarray) or output.dtype != np.float32 or output.shape not in ((1, 1, *size), (1, *size)):
        kind = f"{output.dtype} {list(output.shape)}" if isinstance(output, np.ndarray) else type(output).__name__
        raise InputError(f"{model}: its output is {kind}; for this pair it must be float32 [1, 1, {size[0]}, {size[1]}]")
    found = output.reshape(size)
    return np.where(np.isfinite(found) & (found >= 0), found, np.float32(np.nan))


def _faults(runtime: types.ModuleType) -> tuple[type[Exception], ...]:
    """Everything onnxruntime raises: its exceptions have no common base."""
    state = runtime.capi.onnxruntime_pybind11_state
    named = (getattr(state, name) for name in dir(state))
    return tuple(kind for kind in named if isinstance(kind, type) and issubclass(kind, Exception))


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0][:300]
