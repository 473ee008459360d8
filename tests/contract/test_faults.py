"""Every fault of the simulated cameras at every moment of a cell's life: the right end, and never a wrong image."""

import contextlib
import re
import threading
import time
import zlib
from collections.abc import Callable, Iterator

import pytest

from binpick import settings
from binpick.camera import sync
from binpick.camera.aravis import AravisCamera, Setup
from binpick.camera.base import MonotonicNs
from binpick.camera.group import CameraGroup
from binpick.camera.starter import Starter
from binpick.cell import machine, worker
from binpick.cell.board import Board
from binpick.cell.gallery import Gallery
from binpick.cell.meter import Meter
from binpick.cell.worker import Worker
from binpick.cycle import CycleInput, CycleResult
from binpick.data import Image, Light
from binpick.errors import CameraHeld, Code
from binpick.lab import footprint
from binpick.lab.rig import free
from binpick.result import Request, Result, ReturnCode
from binpick.rig import Rig
from binpick.settings import Bin, Pose, Recipe
from binpick.settings.cell import AravisCameras, CameraAddress, Sync
from binpick.sim.gige import GigeGroup, faults
from binpick.sim.gige.numbered import Numbered, read

pytestmark = [pytest.mark.gige, pytest.mark.slow]

SIZE = (640, 400)
LINK_MBPS = 100.0
"""An image takes 20 ms, and a fault 8 ms after its exposure comes in its midst."""
MAX_SKEW_US = 500_000.0
LIMIT_S = 30.0
"""Of waits that end as soon as what they wait for is so."""
FOUND_S, BACK_S = 3.0, 10.0
"""Of a loaded machine; `binpick bench cameras --reconnects` measures 1.1 s and 0.6 s."""
GOOD = Code.BIN_EMPTY
STEPS = ("idle", "between the triggers", "mid-transfer")
EYE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
K = ((600.0, 0.0, 320.0), (0.0, 600.0, 200.0), (0.0, 0.0, 1.0))
RIG = Rig.model_validate({"image_size_px": SIZE, "cameras": [
    {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T}
    for name, T in (("left", EYE), ("right", ((1.0, 0.0, 0.0, -0.15), *EYE[1:])))]})
CELL = settings.Cell.model_validate({
    "bins": [Bin(inner_size_m=(0.6, 0.4, 0.18), pose=Pose(position_m=(0, 0, 1)))],
    "recipes": [Recipe(frame="camera", exposure_us=2000.0)], "control": "rest"})
HARMLESS = ("loss=0.05", "duplicate=0.3", "reorder=0.3", "late=0.05", "early_leader", "ptp=Listening")
MAIMED = ("mute", "loss=1", "pixel_format=Mono12p", "mtu=800")
GONE = ("unplug", "freeze", "power=off", "reboot=1", "stolen")
LINE = (("line", "unplug@left"), ("line", "power=off@left"), ("line", "stolen@right"))
"""The first camera triggers the second by a wire."""


class Hooked(AravisCamera):
    """Something may happen just before its trigger."""

    before: Callable[[], None] = staticmethod(lambda: None)

    def trigger(self, sequence: int, deadline_ns: MonotonicNs) -> None:
        happens, self.before = self.before, lambda: None
        happens()
        super().trigger(sequence, deadline_ns)


class Stand:
    """A cell's thread over two simulated cameras whose pictures carry their number; it looks at every image it is given."""

    def __init__(self, mode: Sync, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.board = Board(machine.State(max_age_ns=10**12), 1, "rest")
        self.wrong: list[str] = []
        self._source = Numbered(2, SIZE)
        self._midway: Callable[[], None] | None = None
        self._began_ns, self._rebooting = 0, False
        addresses = free()
        self.gige = GigeGroup(self._picture, addresses, SIZE, settle_s=0.1)
        left, right = (CameraAddress(address=address) for address in addresses)
        wanted = self.settings = AravisCameras(left=left, right=right, sync=mode, max_skew_us=MAX_SKEW_US)
        self.cameras = tuple(Hooked(("left", "right")[index], address, "", Setup(sync.steps(wanted, first=index == 0)))
                             for index, address in enumerate(addresses))
        self._last = self.cameras[0 if mode == "line" else 1]
        self.group = CameraGroup(self.cameras, MAX_SKEW_US, starter=Starter(mode, sync.device_key(wanted)))
        self.thread = worker.thread(Worker(self.board, Gallery(), self.group, RIG, self._run, lambda _, cycle, __: cycle, None,
                                           time.monotonic_ns, Meter(RIG)))

    def __enter__(self) -> "Stand":
        self.gige.start()
        self.clear()
        self.thread.start()
        self.wait(lambda: self.ready)
        return self

    def __exit__(self, *_: object) -> None:
        self.board.step(machine.stop, time.monotonic_ns())
        self.thread.join(LIMIT_S)
        self.wait(lambda: not any(thread.name.startswith("binpick-cam-") for thread in threading.enumerate()))
        self.gige.stop()

    @property
    def ready(self) -> bool:
        return self.board.state.phase == "ready"

    @property
    def reasons(self) -> list[str]:
        """Why cameras are down."""
        return [camera.error for camera in self.board.state.cameras if camera.error]

    def wait(self, until: Callable[[], bool]) -> float:
        """Seconds until it is so, without those for which the machine stood still."""
        start = self.clock()
        while not until():
            assert self.clock() - start < LIMIT_S, (self.board.state.phase, self.reasons)
            time.sleep(0.01)
        return self.clock() - start

    def cycle(self) -> Result:
        self._began_ns = time.time_ns()
        job, now_ns = settings.resolve(CELL, 0, 0, 0), time.monotonic_ns()
        number = self.board.step(machine.start, Request(), job, now_ns, 30 * 10**9).last_id
        found = machine.find(self.board.wait(lambda state: state.ticket is None, LIMIT_S), number)
        assert found is not None
        assert found.result.return_code.code in (GOOD, Code.CAMERAS), found.result
        return found.result

    def good(self) -> bool:
        """A cycle is started, and ends well."""
        return self.ready and self.cycle().return_code.code is GOOD

    def beset(self, step: str, happens: Callable[[], None]) -> Result | None:
        """It happens in that step; the result of the cycle in which it did."""
        if step == "idle":
            happens()
            return None
        if step == "between the triggers":
            self._last.before = happens
        else:
            self._midway = happens
        return self.cycle()

    def fault(self, words: str) -> Callable[[], None]:
        self._rebooting = words.startswith("reboot")
        return lambda: faults.apply(self.gige, faults.parse(words))

    def clear(self) -> None:
        """Ends every fault."""
        if self._rebooting:
            self.wait(lambda: self.gige.powered(1))
            self._rebooting = False
        faults.apply(self.gige, faults.parse("clear"))
        for head in self.gige.heads:
            self.gige.change(head, link_mbps=LINK_MBPS)

    def _picture(self, index: int, light: Light, shot: int) -> Image:
        if index == 1 and self._midway is not None:
            threading.Timer(0.008, self._midway).start()
            self._midway = None
        return self._source(index, light, shot)

    def _run(self, inputs: CycleInput, _proceed: Callable[[], None]) -> CycleResult:
        """In the place of the pipeline: are these the images that were sent, of this cycle, of one instant?"""
        started_ns = []
        for head, frame in enumerate((inputs.pair.left, inputs.pair.right)):
            crc32, number = zlib.crc32(frame.image.tobytes()), read(frame.image)
            sent = [entry for entry in self.gige.truth(head) if (entry.block, entry.crc32) == (frame.frame_id, crc32)
                    and (head, entry.shot) == number and entry.started_ns >= self._began_ns]
            started_ns += [entry.started_ns for entry in sent]
            if len(sent) != 1:
                self.wrong.append(f"{frame.camera}: frame {frame.frame_id} with {number} is not what was sent")
        if len(started_ns) == 2 and abs(started_ns[1] - started_ns[0]) > 1000 * MAX_SKEW_US:
            self.wrong.append(f"the pair of cycle {inputs.cycle_id} is not of one instant")
        return CycleResult(Result(cycle_id=inputs.cycle_id, request=inputs.request, captured_at=inputs.pair.captured_at,
                                  simulated=True, return_code=ReturnCode.of(GOOD), bin=None))


@pytest.fixture(scope="module")
def stands(clock: Callable[[], float]) -> Iterator[Callable[[Sync], Stand]]:
    """One at a time."""
    with contextlib.ExitStack() as stack:
        kept: dict[Sync, Stand] = {}

        def stand(mode: Sync) -> Stand:
            if mode not in kept:
                stack.close()
                kept.clear()
                kept[mode] = stack.enter_context(Stand(mode, clock))
            return kept[mode]
        yield stand


@pytest.fixture(autouse=True)
def no_leaked_threads() -> None:
    """The cell outlives a test here; its last one waits for all threads."""


@pytest.fixture
def stand(stands: Callable[[Sync], Stand], request: pytest.FixtureRequest) -> Iterator[Stand]:
    """Ready, with a good cycle behind it; afterwards without a fault, and every image was what it should be."""
    found = stands(getattr(request, "param", "software"))
    found.wait(found.good)
    yield found
    found.clear()
    found.wait(found.good)
    assert found.wrong == []


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("fault", HARMLESS)
def test_what_the_network_does_to_packets_costs_no_cycle(stand: Stand, fault: str, step: str) -> None:
    failures = [status.failures for status in stand.group.statuses()]
    held_s = time.monotonic() - stand.clock()
    result = stand.beset(step, stand.fault(f"{fault}@right")) or stand.cycle()
    for _ in range(2):
        result = stand.cycle() if result.return_code.code is GOOD else result
    if time.monotonic() - stand.clock() - held_s < 0.1:            # else it may have been the machine
        assert result.return_code.code is GOOD, result.return_code
        assert stand.ready
        assert [status.failures for status in stand.group.statuses()] == failures


@pytest.mark.parametrize("step", STEPS)
def test_a_second_controller_is_refused_and_disturbs_nobody(stand: Stand, step: str) -> None:
    refused = []

    def intrude() -> None:
        intruder = AravisCamera("right", stand.settings.right.address, "", Setup(()))
        try:
            intruder.open(time.monotonic_ns() + 5 * 10**9)
        except CameraHeld as error:
            refused.append(error)
        intruder.close()

    result = stand.beset(step, intrude) or stand.cycle()
    stand.wait(lambda: bool(refused))
    assert result.return_code.code is GOOD, result.return_code


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(("stand", "fault"), [*(("software", fault) for fault in MAIMED), ("line", "wire=off")],
                         indirect=["stand"])
def test_a_camera_without_usable_images_is_refused_by_name_and_tried_again(stand: Stand, fault: str, step: str) -> None:
    result = stand.beset(step, stand.fault(f"{fault}@right"))
    if result is None:
        assert stand.ready                       # its answers are as ever: only an image can show it
    if result is None or result.return_code.code is GOOD:        # what had left before is an image still
        assert step != "between the triggers"
        result = stand.cycle()
    assert result.return_code.code is Code.CAMERAS
    assert "camera right" in result.return_code.message
    assert "camera left" not in result.return_code.message
    stand.clear()
    assert stand.wait(stand.good) < BACK_S


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(("stand", "fault"), [*(("software", f"{fault}@right") for fault in GONE), *LINE], indirect=["stand"])
def test_a_camera_that_is_gone_is_found_and_had_again(stand: Stand, fault: str, step: str) -> None:
    _, _, name = fault.partition("@")
    result = stand.beset(step, stand.fault(fault))
    if result is None or result.return_code.code is GOOD:
        assert stand.wait(lambda: not stand.ready) < FOUND_S
    else:
        assert re.findall("camera (left|right)", result.return_code.message) == [name]
    assert all(reason.startswith(f"camera {name}") for reason in stand.reasons), stand.reasons
    stand.clear()
    assert stand.wait(stand.good) < BACK_S
    assert stand.reasons == []


def test_thirty_reconnects_leave_nothing_behind(stand: Stand) -> None:
    """Threads, file descriptors and memory are flat over the last twenty."""
    counted = []
    for turn in range(30):
        stand.fault(("stolen@right", "power=off@right", "stolen")[turn % 3])()
        stand.wait(lambda: not stand.ready)
        stand.clear()
        stand.wait(stand.good)
        if turn in (9, 29):
            counted.append(footprint.settled(cameras=2))
    before, after = counted
    assert after.threads <= before.threads
    assert after.files <= before.files
    assert after.memory_mb - before.memory_mb < 10            # of 20 reconnects; the buffers of one stream are 1.5 MB
