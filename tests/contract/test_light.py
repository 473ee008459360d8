"""The cell's light over real packets: auto exposure, ranges, the projector's line and a second exposure, from images alone."""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from binpick import settings
from binpick.camera import backends
from binpick.camera.group import CameraGroup
from binpick.cell.meter import Meter, Settled
from binpick.data import Image, Light, StereoPair
from binpick.errors import CameraError
from binpick.result import Request
from binpick.rig import Rig
from binpick.settings.cell import AravisCameras, CameraAddress
from binpick.sim.gige import GigePair, features

WIDTH, HEIGHT = 320, 200
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
RIGHT = ((1.0, 0.0, 0.0, -0.1), *EYE[1:])
K = ((250.0, 0.0, 160.0), (0.0, 250.0, 100.0), (0.0, 0.0, 1.0))
RIG = Rig.model_validate({"image_size_px": (WIDTH, HEIGHT), "cameras": [
    {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T} for name, T in (("left", EYE), ("right", RIGHT))]})

pytestmark = pytest.mark.gige


def within(seconds: float) -> int:
    return time.monotonic_ns() + int(seconds * 1e9)


@dataclass
class Scene:
    """Grey parts in the middle, a lamp beside the bin that has nothing to say; what each shot of the left was taken with."""

    lamp: float = 140 / 3000
    projector: float = 2.0
    right: float = 0.8
    shots: list[Light] = field(default_factory=list)

    def image(self, index: int, light: Light, _shot: int) -> Image:
        if index == 0:
            self.shots.append(light)
        steps = self.lamp * light.exposure_us * 10 ** (light.gain_db / 20) * (self.projector if light.projector else 1.0)
        picture = np.full((HEIGHT, WIDTH), min(round(steps * (self.right if index else 1.0)), 255), np.uint8)
        picture[:, :30] = 255
        return picture


def job(**recipe: object) -> settings.Job:
    return settings.resolve(settings.Cell.model_validate({
        "bins": [{"inner_size_m": (0.3, 0.3, 0.1), "pose": {"position_m": (0.05, 0, 1), "rotvec_rad": (np.pi, 0, 0)}}],
        "recipes": [{"frame": "camera", **recipe}], "control": "none"}))


@dataclass
class Bench:
    """One cell's cameras and its meter; `cycle` takes what a cycle takes."""

    scene: Scene
    group: CameraGroup
    meter: Meter = field(default_factory=lambda: Meter(RIG))

    def cycle(self, job: settings.Job) -> tuple[Settled, list[StereoPair], int]:
        """What was settled, the cycle's own pairs, and how many test shots came before them."""
        before = len(self.scene.shots)
        settled = self.meter.settle(job, Request(), self.group.statuses(), self._capture)
        tested = len(self.scene.shots) - before
        pairs = [self._capture(light) for light in settled.lights]
        self.meter.watch(job, Request(), settled.lights, pairs)
        return settled, pairs, tested

    def _capture(self, light: Light) -> StereoPair:
        return self.group.capture(light, within(5))


@contextlib.contextmanager
def bench(addresses: tuple[str, str], scene: Scene, *recipes: settings.Recipe) -> Iterator[Bench]:
    left, right = (CameraAddress(address=address) for address in addresses)
    cameras = AravisCameras(left=left, right=right, max_skew_us=1_000_000.0)
    with GigePair(scene.image, addresses, (WIDTH, HEIGHT)), contextlib.closing(backends.group(cameras, recipes)) as group:
        group.open(within(5))
        yield Bench(scene, group)


def test_exposure_settles_before_the_first_cycle_and_stays_until_the_light_changes(gige_addresses: tuple[str, str]) -> None:
    auto = job(exposure_us="auto")
    with bench(gige_addresses, Scene()) as cell:
        settled, (pair,), tested = cell.cycle(auto)
        assert settled.outcome == "settled"
        assert 2 <= tested <= 6
        assert pair.left.exposure_us == pair.right.exposure_us == pytest.approx(1500, rel=0.12)
        assert np.median(pair.left.image) == pytest.approx(140, rel=0.12)
        assert cell.cycle(auto)[2] == 0
        cell.scene.lamp *= 1.2                          # within the band
        assert [cell.cycle(auto)[2] for _ in range(2)] == [0, 0]
        cell.scene.lamp *= 3
        _, (during,), tested = cell.cycle(auto)         # a cycle keeps what it began with
        assert (tested, during.left.exposure_us) == (0, pair.left.exposure_us)
        _, (after,), tested = cell.cycle(auto)
        assert tested >= 2
        assert np.median(after.left.image) == pytest.approx(140, rel=0.12)


def test_shots_with_and_without_the_projector_are_exposed_each_for_itself(gige_addresses: tuple[str, str]) -> None:
    with bench(gige_addresses, Scene()) as cell:
        settled, pairs, _ = cell.cycle(job(exposure_us="auto", projector="alternate", hdr=5))
        assert [(light.projector, light.metered) for light in settled.lights] == [(True, True)] * 2 + [(False, True)] * 2
        assert [light.projector for light in cell.scene.shots[-4:]] == [True, True, False, False]       # the strobe's line
        taken = [pair.left.exposure_us for pair in pairs]
        assert taken == pytest.approx([1500, 300, 3000, 600], rel=0.15)
        assert taken[0] / taken[1] == pytest.approx(5, rel=0.02)
        assert [np.median(pair.left.image) for pair in pairs] == pytest.approx([140, 28, 140, 28], rel=0.15)


@pytest.mark.parametrize(("lamp", "outcome"), [(0.0, "too_dark"), (100.0, "too_bright")])
def test_what_cannot_be_exposed_well_is_named_and_taken_nevertheless(
        gige_addresses: tuple[str, str], lamp: float, outcome: str) -> None:
    auto = job(exposure_us="auto", auto={"longest_us": 8000})
    with bench(gige_addresses, Scene(lamp=lamp)) as cell:
        settled, pairs, tested = cell.cycle(auto)
        assert (settled.outcome, len(pairs)) == (outcome, 1)
        assert tested < 10
        assert cell.cycle(auto)[2] == 0


@pytest.mark.parametrize(("recipe", "says"), [
    ({"number": 7, "exposure_us": 20.0, "shots": [{}, {"exposure_us": 30_000.0}]},
     r"camera left: recipe 7, shot 1: exposure_us is 20, but this camera's range is 100 to 20000"),
    ({"shots": [{"exposure_us": 500.0}, {"exposure_us": 30_000.0}]}, r"recipe 1, shot 2: exposure_us is 30000"),
    ({"exposure_us": "auto"}, r"recipe 1: auto.longest_us is 30000"),
    ({"gain_db": 18.0}, r"recipe 1, shot 1: gain_db is 18, but this camera's range is 0 to 12")])
def test_a_setting_out_of_the_cameras_own_range_is_refused_at_start_up_by_name(
        gige_addresses: tuple[str, str], monkeypatch: pytest.MonkeyPatch, recipe: dict[str, object], says: str) -> None:
    narrow(monkeypatch)
    with (pytest.raises(CameraError, match=says) as caught,
          bench(gige_addresses, Scene(), settings.Recipe.model_validate(recipe))):
        pass
    assert type(caught.value) is CameraError


def test_metering_stays_within_the_cameras_range_which_its_status_tells(
        gige_addresses: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    narrow(monkeypatch)
    with bench(gige_addresses, Scene(lamp=100.0)) as cell:
        assert {status.exposure_range_us for status in cell.group.statuses()} == {(100.0, 20_000.0)}
        settled, (pair,), _ = cell.cycle(job(exposure_us="auto"))
        assert (settled.outcome, pair.left.exposure_us) == ("too_bright", 105.0)          # as it is, not as it was asked for
        with pytest.raises(CameraError, match="ExposureTime should be 50, but this camera's range is 100 to 20000"):
            cell.group.capture(Light(50.0, 0.0, projector=False), within(5))


def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras of another model, that expose 0.1 to 20 ms, in steps of 7 µs, with at most 12 dB."""
    usual = features.table
    ranges = {"ExposureTime": (100, 20_000), "Gain": (0, 12)}

    def table(width: int, height: int, serial: str) -> list[features.Feature]:
        return [replace(row, minimum=ranges[row.name][0], maximum=ranges[row.name][1],
                        increment=7.0 if row.name == "ExposureTime" else 0.0) if row.name in ranges else row
                for row in usual(width, height, serial)]

    monkeypatch.setattr(features, "table", table)
