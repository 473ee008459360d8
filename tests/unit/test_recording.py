"""A recording gives back what went in, appears whole or not at all, and never holds a cycle up."""

import json
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from binpick import pipeline, recording, settings
from binpick.cycle import CycleInput
from binpick.data import Frame, StereoPair, frozen
from binpick.errors import Code, ImageError, InputError, RigError
from binpick.outcomes import Attempt, Grid, Look, Memory
from binpick.recording import Recorder
from binpick.result import Request, failure
from binpick.rig import Rig
from binpick.settings import Bin, Pose, Recipe
from binpick.settings.recipe import Shot

EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
K = ((170.0, 0.0, 96.3), (0.0, 170.0, 60.1), (0.0, 0.0, 1.0))
WIDTH, HEIGHT = 192, 120


def inputs(cycle_id: int = 12, seed: int = 1) -> CycleInput:
    draw = np.random.default_rng(seed)
    scene = draw.integers(0, 256, (HEIGHT, WIDTH + 26), dtype=np.uint8)

    def frame(name: str, shift: int) -> Frame:
        image = frozen(np.ascontiguousarray(scene[:, shift:shift + WIDTH]))
        return Frame(image, name, 4, 9, 2**60 + 1, 10, 20, 6000.25, 1.5, 2, 0)

    rig = Rig.model_validate({
        "image_size_px": (WIDTH, HEIGHT),
        "cameras": [{"name": name, "K": K, "distortion": (0.1, -0.02, 1e-17, 0.3, 1 / 3), "T_cam_rig": T}
                    for name, T in (("left", EYE), ("right", ((1.0, 0.0, 0.0, -0.15), *EYE[1:])))]})
    cell = settings.Cell(
        bins=(Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose(position_m=(0, 0, 1), rotvec_rad=(np.pi, 0, 0))),),
        recipes=(Recipe(frame="camera"),))
    pair = StereoPair(frame("left", 0), frame("right", 26), "2026-01-02T03:04:05.678Z", 12.5, 0.1, "ptp")
    return CycleInput(cycle_id, pair, rig, settings.resolve(cell), Request(frame="camera", request_id="a"), simulated=True)


def test_what_comes_back_is_what_went_in(tmp_path: Path) -> None:
    given, answer = inputs(), failure(12, Request(), Code.NO_DEPTH)
    recording.save(tmp_path / "one", given, answer)
    got, got_answer = recording.load(tmp_path / "one")
    assert got_answer == answer
    assert (got.cycle_id, got.rig, got.job, got.request, got.simulated) == (
        given.cycle_id, given.rig, given.job, given.request, given.simulated)
    assert (got.pair.captured_at, got.pair.skew_us, got.pair.sigma_us, got.pair.proof) == (
        given.pair.captured_at, 12.5, 0.1, "ptp")
    for side in ("left", "right"):
        before, after = getattr(given.pair, side), getattr(got.pair, side)
        assert np.array_equal(before.image, after.image)
        assert not after.image.flags.writeable
        for field in fields(Frame):
            if field.name != "image":
                assert getattr(before, field.name) == getattr(after, field.name), field.name
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == [
        "input.json", "job.json", "left.png", "result.json", "rig.json", "right.png"]
    facts = json.loads((tmp_path / "one" / "input.json").read_text())
    assert set(facts["made_with"]) == {"binpick", "opencv", "numpy", "machine"}
    assert not {"more", "memory", "metering"} & set(facts)            # as before there were shots and outcomes


def test_a_recording_computes_to_the_same_bytes(tmp_path: Path) -> None:
    live = pipeline.run(inputs()).result
    recording.save(tmp_path / "one", inputs(), live)
    got, stored = recording.load(tmp_path / "one")
    assert pipeline.run(got).result.timeless_bytes() == live.timeless_bytes() == stored.timeless_bytes()


def test_what_was_remembered_before_the_cycle_is_in_it(tmp_path: Path) -> None:
    patch = Grid.of(np.arange(400, dtype=np.int16).reshape(20, 20))
    attempt = Attempt(captured_at="2026-01-02T03:04:05.678Z", cycle_id=11, grasp=1, tool=1, position_m=(0.1, 1 / 3, 0.02),
                      approach=(0.0, 0.0, -1.0), reach_m=0.02, patch=patch, outcome=2)
    given = replace(inputs(), memory=Memory(attempts=(attempt,), look=Look(heights=patch, parts=patch, attempts=(attempt,))))
    recording.save(tmp_path / "one", given, failure(12, Request(), Code.NO_DEPTH))
    assert recording.load(tmp_path / "one")[0].memory == given.memory


def three_shots() -> CycleInput:
    """The second with the projector off, the third of another pattern; each with facts of its own."""
    given = inputs()
    shots = (Shot(), Shot(projector=False), Shot(exposure_us=1200.0, pattern=2))
    job = given.job.model_copy(update={"recipe": given.job.recipe.model_copy(update={"shots": shots})})
    more = tuple(replace(inputs(seed=seed).pair, skew_us=float(seed), captured_at=f"2026-01-02T03:04:0{seed}.000Z")
                 for seed in (2, 3))
    return replace(given, job=job, more=more)


def test_every_shot_of_a_cycle_is_kept_and_computes_to_the_same_bytes(tmp_path: Path) -> None:
    given = three_shots()
    live = pipeline.run(given).result
    recording.save(tmp_path / "one", given, live)
    assert sorted(path.name for path in (tmp_path / "one").glob("*.png")) == [
        "left-02.png", "left-03.png", "left.png", "right-02.png", "right-03.png", "right.png"]
    got, _ = recording.load(tmp_path / "one")
    assert len(got.pairs) == len(given.pairs) == 3
    for before, after in zip(given.pairs, got.pairs, strict=True):
        assert np.array_equal(before.left.image, after.left.image)
        assert np.array_equal(before.right.image, after.right.image)
        assert (before.skew_us, before.captured_at) == (after.skew_us, after.captured_at)
    assert pipeline.run(got).result.timeless_bytes() == live.timeless_bytes()


def test_what_auto_exposure_found_is_in_it_and_in_the_answer(tmp_path: Path) -> None:
    given = inputs()
    recipe = Recipe.model_validate(given.job.recipe.model_dump() | {"exposure_us": "auto", "projector": "alternate", "hdr": 4})
    times = (2000.0, 500.0, 9000.0, 2250.0)
    pairs = [replace(pair, left=replace(pair.left, exposure_us=time_us), right=replace(pair.right, exposure_us=time_us + 1))
             for pair, time_us in ((inputs(seed=seed).pair, time_us) for seed, time_us in enumerate(times))]
    given = replace(given, pair=pairs[0], more=tuple(pairs[1:]), metering="too_dark",
                    job=given.job.model_copy(update={"recipe": recipe}))
    assert [light.exposure_us for light in given.lights] == list(times)
    live = pipeline.run(given).result
    assert live.sync is not None
    assert live.sync.metering == "too_dark"
    assert [(shot.projector, shot.exposure_us) for shot in live.sync.shots] == [
        (on, (time_us, time_us + 1)) for on, time_us in zip((True, True, False, False), times, strict=True)]
    recording.save(tmp_path / "one", given, live)
    assert pipeline.run(recording.load(tmp_path / "one")[0]).result.timeless_bytes() == live.timeless_bytes()


@pytest.mark.parametrize(("name", "error"), [("right-03.png", ImageError), ("left-02.png", ImageError)])
def test_a_missing_shot_is_named(tmp_path: Path, name: str, error: type[InputError]) -> None:
    recording.save(tmp_path / "one", three_shots(), failure(12, Request(), Code.NO_DEPTH))
    (tmp_path / "one" / name).unlink()
    with pytest.raises(error, match=name):
        recording.load(tmp_path / "one")


def test_as_many_shots_as_the_recipe_says(tmp_path: Path) -> None:
    recording.save(tmp_path / "one", replace(three_shots(), more=()), failure(12, Request(), Code.NO_DEPTH))
    with pytest.raises(InputError, match=r"1 shots, but the recipe in job\.json has 3"):
        recording.load(tmp_path / "one")


def test_a_folder_is_never_overwritten_and_never_half_there(tmp_path: Path) -> None:
    recording.save(tmp_path / "one", inputs(), failure(12, Request(), Code.NO_DEPTH))
    with pytest.raises(InputError, match="exists already"):
        recording.save(tmp_path / "one", inputs(), failure(12, Request(), Code.NO_DEPTH))
    assert [path.name for path in tmp_path.iterdir()] == ["one"]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        recording.save(tmp_path / "file" / "two", inputs(), failure(12, Request(), Code.NO_DEPTH))


@pytest.mark.parametrize(("name", "body", "error"), [
    ("left.png", b"no picture", ImageError), ("left.png", None, ImageError), ("input.json", b"{}", InputError),
    ("input.json", None, InputError), ("rig.json", b"{}", RigError), ("job.json", b'{"x": 1}', InputError),
    ("result.json", b"", InputError)])
def test_a_damaged_file_is_named(tmp_path: Path, name: str, body: bytes | None, error: type[InputError]) -> None:
    recording.save(tmp_path / "one", inputs(), failure(12, Request(), Code.NO_DEPTH))
    (tmp_path / "one" / name).unlink()
    if body is not None:
        (tmp_path / "one" / name).write_bytes(body)
    with pytest.raises(error, match=name):
        recording.load(tmp_path / "one")


def test_the_recorder_saves_in_its_own_thread(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "kept")
    recorder.start()
    recorder.offer(inputs(12), failure(12, Request(), Code.NO_DEPTH))
    recorder.offer(inputs(13), failure(13, Request(), Code.NO_DEPTH))
    assert recorder.close(10.0)
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == [
        "20260102T030405678Z-000012", "20260102T030405678Z-000013"]
    assert (recorder.status().saved, recorder.status().dropped, recorder.status().trouble) == (2, 0, "")


def test_a_full_queue_drops_and_says_so_at_once(tmp_path: Path, clock: Callable[[], float]) -> None:
    recorder = Recorder(tmp_path)  # its thread does not run: the slowest disk there is
    given = inputs()
    started = clock()
    for _ in range(4):
        recorder.offer(given, failure(12, Request(), Code.NO_DEPTH))
    assert clock() - started < 0.5
    assert recorder.status().dropped == 2
    assert "dropped" in recorder.status().trouble
    assert not recorder.close(0.05)
    recorder.start()
    assert recorder.close(10.0)


def test_a_disk_that_refuses_is_told_and_the_recorder_lives_on(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    recorder.start()
    for done, cycle_id in enumerate((12, 12, 13), start=1):
        recorder.offer(inputs(cycle_id), failure(cycle_id, Request(), Code.NO_DEPTH))
        while recorder.status().saved + recorder.status().failed < done:
            time.sleep(0.005)
    assert recorder.close(10.0)
    assert (recorder.status().saved, recorder.status().failed, recorder.status().trouble) == (2, 1, "")


def test_a_directory_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"recording\.directory"):
        Recorder(tmp_path / "file").start()
