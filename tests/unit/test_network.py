"""A block matcher written by hand as an ONNX graph must measure planted shifts; what does not fit is refused by name."""

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from binpick.data import Rectified, Window
from binpick.errors import InputError
from binpick.settings.stereo import Onnx, StereoSettings
from binpick.stereo import depth, network
from binpick.stereo.search import search, search_right

SHIFTS = 32
FLOAT = TensorProto.FLOAT


def block_matcher(sides: tuple[int | str, int | str] = ("h", "w"), channels: int = 1) -> onnx.ModelProto:
    """A cost volume over SHIFTS shifts: pad and slice, absolute difference, 9x9 mean, then a sharp soft-argmin."""
    integers = {"zero": [0], "one": [1], "three": [3], "minus": [-1], "axes": [3]}
    constants = [numpy_helper.from_array(np.array(v, dtype=np.int64), n) for n, v in integers.items()]
    constants += [numpy_helper.from_array(np.array([-4.0], dtype=np.float32), "sharpness"),
                  numpy_helper.from_array(np.arange(SHIFTS, dtype=np.float32).reshape(1, SHIFTS, 1, 1), "shift"),
                  numpy_helper.from_array(np.array([0, 0, 0, SHIFTS, 0, 0, 0, 0], dtype=np.int64), "border")]
    nodes = [helper.make_node("ReduceMean", [name], [f"{name}_grey"], axes=[1], keepdims=1) for name in ("left", "right")]
    nodes.append(helper.make_node("Pad", ["right_grey", "border"], ["wide"], mode="edge"))
    for d in range(SHIFTS):
        constants += [numpy_helper.from_array(np.array([v], dtype=np.int64), f"{n}{d}")
                      for n, v in (("from", SHIFTS - d), ("to", -d if d else 2**31))]
        nodes += [helper.make_node("Slice", ["wide", f"from{d}", f"to{d}", "axes"], [f"moved{d}"]),
                  helper.make_node("Sub", ["left_grey", f"moved{d}"], [f"difference{d}"]),
                  helper.make_node("Abs", [f"difference{d}"], [f"cost{d}"])]
    nodes += [helper.make_node("Concat", [f"cost{d}" for d in range(SHIFTS)], ["costs"], axis=1),
              helper.make_node("AveragePool", ["costs"], ["volume"], kernel_shape=[9, 9], pads=[4, 4, 4, 4]),
              helper.make_node("Mul", ["volume", "sharpness"], ["scores"]),
              helper.make_node("Softmax", ["scores"], ["weights"], axis=1),
              helper.make_node("Mul", ["weights", "shift"], ["weighted"]),
              helper.make_node("ReduceSum", ["weighted", "one"], ["disparity"], keepdims=1)]
    images = [helper.make_tensor_value_info(name, FLOAT, [1, channels, *sides]) for name in ("left", "right")]
    answer = helper.make_tensor_value_info("disparity", FLOAT, [1, 1, *sides])
    return model(nodes, images, [answer], constants)


def model(nodes, inputs, outputs, constants=()) -> onnx.ModelProto:
    made = helper.make_model(helper.make_graph(nodes, "stereo", inputs, outputs, list(constants)),
                             opset_imports=[helper.make_opsetid("", 17)])
    made.ir_version = 8
    onnx.checker.check_model(made)
    return made


def value(name: str, shape: list, kind: int = FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def saved(made: onnx.ModelProto, folder: Path) -> Path:
    path = folder / "model.onnx"
    onnx.save(made, path)
    return path


def planted(shift: int, rows: int = 70, cols: int = 150) -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(2).uniform(0, 255, (rows, cols + 64)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 1.0)
    texture = np.clip(4 * (texture - texture.mean()) + 128, 0, 255).astype(np.uint8)
    return texture[:, :cols].copy(), texture[:, shift:cols + shift].copy()


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("shift", [3, 17, 28])
def test_a_planted_shift_is_measured_in_both_views(shift, channels, tmp_path):
    matcher = Onnx(model=saved(block_matcher(channels=channels), tmp_path))
    left, right = planted(shift)
    found = search(left, right, 32, matcher)
    assert found.shape == left.shape
    assert np.median(np.abs(found[:, 36:] - shift)) < 0.02
    assert np.isfinite(found[:, 36:]).mean() > 0.99
    from_right = search_right(left, right, 32, matcher)
    inside = from_right[:, 8:-36]
    assert np.median(np.abs(inside - shift)) < 0.02
    # what the last columns of the right view show lies outside of the left one
    reach = np.arange(150)[::-1]
    assert not (np.nan_to_num(from_right) > reach).any()


def test_a_fixed_size_is_padded_to_and_a_smaller_one_is_refused(tmp_path):
    left, right = planted(17)
    fitting = saved(block_matcher((80, 160)), tmp_path)
    assert np.median(np.abs(network.disparity(left, right, fitting)[:, 36:] - 17)) < 0.02
    with pytest.raises(InputError, match="takes images of 160x80 px, but the window with its search margin is 161x70"):
        network.disparity(*planted(17, cols=161), fitting)


def test_what_the_model_did_not_measure_is_nan_not_an_error(tmp_path):
    nodes = [helper.make_node("Sub", ["left", "right"], ["difference"]), helper.make_node("Sqrt", ["difference"], ["root"]),
             helper.make_node("Squeeze", ["root", "axis"], ["disparity"])]
    constants = [numpy_helper.from_array(np.array([1], dtype=np.int64), "axis")]
    images = [value(name, [1, 1, "h", "w"]) for name in ("left", "right")]
    path = saved(model(nodes, images, [value("disparity", [1, "h", "w"])], constants), tmp_path)
    left, right = np.full((40, 64), 29, np.uint8), np.full((40, 64), 20, np.uint8)
    right[:, 32:] = 30
    found = network.disparity(left, right, path)
    assert (found[:, :32] == 3).all()
    assert np.isnan(found[:, 32:]).all()


def test_disparities_outside_the_range_count_as_nothing(tmp_path):
    path = saved(block_matcher(), tmp_path)
    left, right = planted(28)
    found = search(left, right, 16, Onnx(model=path))
    assert np.isnan(found[:, 40:]).mean() > 0.99


def test_threads_do_not_change_the_result(tmp_path):
    path = saved(block_matcher(), tmp_path)
    left, right = planted(17)
    threads = cv2.getNumThreads()
    try:
        found = []
        for count in (1, 2):
            cv2.setNumThreads(count)
            found.append(network.disparity(left, right, path))
    finally:
        cv2.setNumThreads(threads)
    assert found[0].tobytes() == found[1].tobytes()


def test_a_model_is_loaded_once_until_its_file_changes(tmp_path):
    path = saved(block_matcher(), tmp_path)
    first = network.load(path)
    assert network.load(path) is first
    saved(block_matcher(channels=3), tmp_path)
    os.utime(path, ns=(1, 1))
    assert network.load(path).channels == 3


def refused(made: onnx.ModelProto, folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        network.disparity(*planted(3), saved(made, folder))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_model_that_does_not_fit_is_refused_in_one_sentence(tmp_path):
    image, answer = [1, 1, "h", "w"], value("disparity", [1, 1, "h", "w"])
    copy = helper.make_node("Identity", ["left"], ["disparity"])
    assert "has 1 inputs and 1 outputs" in refused(model([copy], [value("left", image)], [answer]), tmp_path)
    stacked = [value("left", [1, 2, "h", "w"]), value("right", [1, 2, "h", "w"])]
    assert "must be float32 [1, 1 or 3, H, W]" in refused(
        model([copy], stacked, [value("disparity", [1, 2, "h", "w"])]), tmp_path)
    bytes_in = [value(name, image, TensorProto.UINT8) for name in ("left", "right")]
    cast = helper.make_node("Cast", ["left"], ["disparity"], to=FLOAT)
    assert "tensor(uint8)" in refused(model([cast], bytes_in, [answer]), tmp_path)
    pair = [value("left", image), value("right", [1, 3, "h", "w"])]
    assert "its two inputs differ" in refused(model([copy], pair, [answer]), tmp_path)
    pair = [value("left", image), value("right", image)]
    small = helper.make_node("MaxPool", ["left"], ["disparity"], kernel_shape=[2, 2], strides=[2, 2])
    assert "its output is float32 [1, 1, 48, 80]" in refused(model([small], pair, [answer]), tmp_path)
    numbers = helper.make_node("Cast", ["left"], ["disparity"], to=TensorProto.DOUBLE)
    assert "its output is float64" in refused(
        model([numbers], pair, [value("disparity", image, TensorProto.DOUBLE)]), tmp_path)


def test_a_model_that_fails_on_the_images_says_so(tmp_path):
    tall = [numpy_helper.from_array(np.array([1, 1, 7, 7], dtype=np.int64), "shape")]
    pair = [value(name, [1, 1, "h", "w"]) for name in ("left", "right")]
    reshape = helper.make_node("Reshape", ["left", "shape"], ["disparity"])
    answer = value("disparity", [1, 1, 7, 7])
    assert "fails on images of 160x96 px" in refused(model([reshape], pair, [answer], tall), tmp_path)


def test_no_file_and_no_model_are_refused(tmp_path):
    with pytest.raises(InputError, match="there is no such model"):
        network.load(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(InputError, match="not a model that can be run"):
        network.load(tmp_path / "text.onnx")


def test_without_onnxruntime_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    path = tmp_path / "other.onnx"
    onnx.save(block_matcher(), path)
    with pytest.raises(InputError, match=r"pip install 'binpick\[onnx\]'"):
        network.load(path)


def test_what_a_network_finds_is_refined_and_judged_by_the_same_bits_on_one_thread_and_on_two(tmp_path):
    left, right = planted(17, rows=80, cols=180)
    pair = Rectified(left, right, Window(0, 0, 180 - SHIFTS, 80, 5, SHIFTS), SHIFTS, 1000.0, 0.1, 90.0, 40.0, np.eye(4))
    settings = StereoSettings(matcher=Onnx(model=saved(block_matcher(), tmp_path)))
    before, found = cv2.getNumThreads(), []
    try:
        for threads in (1, 2):
            cv2.setNumThreads(threads)
            found.append(depth.measure(pair, settings))
    finally:
        cv2.setNumThreads(before)
    assert found[0].measured.mean() > 0.7
    assert np.nanmedian(np.abs(found[0].disparity - 22)) < 0.02
    for name in ("disparity", "measured", "confidence", "sigma_px"):
        assert getattr(found[0], name).tobytes() == getattr(found[1], name).tobytes()
