"""The command line: faults are one line, help is light."""

import importlib
import subprocess
import sys

import pytest

from binpick import cli
from binpick.errors import InputError
from binpick.sim import exam

pick = importlib.import_module("binpick.cli.pick")    # the package shows the command of that name
HEAVY = ("open3d", "nicegui", "cv2", "distributed", "mujoco", "fastapi", "uvicorn")


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["binpick", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def test_a_fault_is_one_line_that_says_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(monkeypatch, "pick", "--left", "l.png", "--right", "r.png", "--rig", "nowhere.json", "--cell", "c.yaml",
                "--out", "out") == 2
    assert capsys.readouterr().err == (
        "binpick: nowhere.json: there is no such rig file; make one with `binpick-calib solve`\n")


def test_check_exits_with_the_worst_finding(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(monkeypatch, "check", "--cell", "nowhere.yaml") == 2
    assert "FAIL" in capsys.readouterr().out


@pytest.mark.parametrize("locate", [False, True])
def test_check_tells_which_bins_are_located(locate: bool) -> None:
    cell = exam.cell("A")
    bins = tuple(model.model_copy(update={"locate": locate}) for model in cell.bins)
    finding = importlib.import_module("binpick.cli.check")._recipe(cell.model_copy(update={"bins": bins}), exam.rig("A"), 1)
    assert ("located by its rim" in finding) is locate


@pytest.mark.parametrize(("given", "says"), [("1 2 3", "seven numbers"), ("1 2 3 0 0 0 x", "seven numbers"),
                                             ("0 0 1 0 0 0 2", "length 1"), ("nan 0 1 0 0 0 1", "finite")])
def test_a_flange_pose_that_is_none_is_refused(given: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        pick._flange(given)


def test_a_flange_pose_is_seven_numbers() -> None:
    flange = pick._flange("0.1 0.2 0.3, 0 0 0 1")
    assert flange is not None
    assert (flange.position_m, flange.quaternion_xyzw) == ((0.1, 0.2, 0.3), (0, 0, 0, 1))


def test_help_imports_nothing_heavy() -> None:
    probe = f"import sys, binpick.cli; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(("address", "says", "code"), [("5020", "HOST:PORT", 2), ("127.0.0.1:1", "no Modbus server", 1)])
def test_bench_says_why_a_daemon_cannot_be_timed(monkeypatch, capsys, address, says, code) -> None:
    assert call(monkeypatch, "bench", "--modbus", address) == code
    assert says in capsys.readouterr().err
