"""The whole cell: packets from simulated cameras through Aravis, poses over Modbus and REST, and a world that judges them."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import numpy as np
import psutil
import pytest
from rich.console import Console

from binpick import demo, pipeline, recording
from binpick.errors import Code, PortInUse
from binpick.sim import exam, score

PICKED = re.compile(r"^ *(\d+)  picked (\w+) .* ([-+][\d.]+) +([\d.]+)° +\d+ ms +\d+ ms$", re.MULTILINE)


def two_free_ports() -> tuple[int, int]:
    with socket.socket() as a, socket.socket() as b:
        a.bind(("127.0.0.1", 0))
        b.bind(("127.0.0.1", 0))
        return int(a.getsockname()[1]), int(b.getsockname()[1])


def start(plan: dict[str, object], headless: bool) -> subprocess.Popen[str]:
    imports = "from pathlib import PosixPath; from binpick import demo"
    program = f"{imports}; raise SystemExit(demo.run(demo.Plan(**{plan!r}), {headless}))"
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)


def read_until(process: subprocess.Popen[str], end: str) -> str:
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if end in line:
            return said
    pytest.fail(f"the demo ended early:\n{said}")


@pytest.mark.gige
@pytest.mark.slow
def test_a_bin_is_picked_through_every_interface(tmp_path: Path) -> None:
    rest, modbus = two_free_ports()
    plan = {"cycles": 3, "parts": 10, "cameras": ("127.0.31.2", "127.0.31.3"), "rest_port": rest, "modbus_port": modbus,
            "recording": tmp_path / "recordings"}
    process = start(plan, headless=False)
    try:
        said = read_until(process, "stays up")
        picks = PICKED.findall(said)
        assert len(picks) >= 2, said
        assert " 0 collisions" in said
        for _, kind, distance_mm, angle_deg in picks:
            assert kind in exam.KINDS
            # the judge's own limits of a good grasp
            assert abs(float(distance_mm)) < 4
            assert float(angle_deg) < 15
        with httpx.Client(base_url=f"http://127.0.0.1:{rest}") as client:
            latest = client.get("/v1/cycles/latest").json()
            health = client.get("/v1/health").json()
            assert client.get("/v1/cycles/latest/overlay.png").content.startswith(b"\x89PNG")
            assert client.get("/v1/cycles/latest/cloud.ply").content.startswith(b"ply\n")
            # Modbus controls this cell: nobody else starts cycles
            assert client.post("/v1/cycles", json={}).status_code == 409
        assert latest["cycle_id"] == 3
        assert latest["simulated"]
        assert health["status"] == "ok", health
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
        assert not psutil.wait_procs(children, timeout=1)[1]
    finally:
        process.kill()
        process.communicate()
    replays_and_picks_the_same(tmp_path)


@pytest.mark.gige
@pytest.mark.slow
def test_the_demo_empties_the_bin() -> None:
    rest, modbus = two_free_ports()
    process = start({"parts": 4, "cameras": ("127.0.36.2", "127.0.36.3"), "rest_port": rest, "modbus_port": modbus}, True)
    said, _ = process.communicate(timeout=90)
    assert process.returncode == 0, said
    assert " 102 bin_empty: The bin is empty" in said
    assert "4 parts picked" in said
    assert "0 collisions; the bin is empty" in said
    # a terminal of 120 columns wraps nothing
    assert max(map(len, said.splitlines())) <= 120


def verdict(reason: str = "", penetration_m: float = 0.0) -> score.Verdict:
    return score.Verdict(1, "block", not reason, reason, 0.0, 0.0, 0.0, penetration_m)


@pytest.mark.parametrize(("cycles", "happened", "left", "exit_code"), [
    (0, ["picked", "empty"], 0, 0),
    (0, ["picked", "missed", "picked", "empty"], 0, 0),
    (0, ["empty"], 0, 0),
    (0, ["picked", "empty"], 1, 1),
    (0, ["picked", "none", "none", "none"], 1, 1),
    (2, ["picked", "missed"], 5, 0),
    (2, ["missed", "none"], 5, 1),
    (5, ["picked", "empty"], 0, 0),
    (5, ["picked", "none", "none", "none"], 5, 1),
    (2, ["picked", "hit"], 5, 1),
])
def test_the_exit_code_tells_how_it_went(cycles: int, happened: list[str], left: int, exit_code: int) -> None:
    what = {"picked": (Code.OK, np.eye(4), verdict()), "missed": (Code.OK, np.eye(4), verdict("the cup is not on one part")),
            "hit": (Code.OK, np.eye(4), verdict("the tool collides", 0.002)), "empty": (Code.BIN_EMPTY, None, None),
            "none": (Code.ALL_COLLIDE, None, None)}
    picks = [demo.Pick(code, 1, 1, 1, T, seen) for code, T, seen in (what[h] for h in happened)]
    assert demo._sum_up(demo.Plan(cycles=cycles), picks, left, Console(quiet=True)) == exit_code


def test_a_port_in_use_is_said_at_once(free_port: int) -> None:
    _, modbus = two_free_ports()
    with socket.socket() as other:
        other.bind(("127.0.0.1", free_port))
        other.listen()
        with pytest.raises(PortInUse, match=f"127.0.0.1:{free_port} .* end the program"):
            demo.run(demo.Plan(rest_port=free_port, modbus_port=modbus), headless=True)


def replays_and_picks_the_same(tmp_path: Path) -> None:
    """What the daemon answered live is what the pipeline and `binpick pick` answer to the recording."""
    demo.files(demo.Plan(parts=10), tmp_path)
    folders = sorted((tmp_path / "recordings").iterdir())
    assert len(folders) == 3
    inputs, live = recording.load(folders[0])
    assert pipeline.run(inputs).result.timeless_bytes() == live.timeless_bytes()
    arguments = ["--left", str(folders[0] / "left.png"), "--right", str(folders[0] / "right.png"),
                 "--rig", str(tmp_path / "rig.json"), "--cell", str(tmp_path / "cell.yaml"), "--out", str(tmp_path / "out")]
    subprocess.run([sys.executable, "-m", "binpick", "pick", *arguments], check=True, stdout=subprocess.DEVNULL, timeout=60)
    picked = type(live).model_validate(json.loads((tmp_path / "out" / "result.json").read_text()))
    assert picked.timeless_bytes() == live.timeless_bytes()


@pytest.mark.gige
@pytest.mark.slow
def test_the_demo_ends_with_sigterm_while_it_starts() -> None:
    rest, modbus = two_free_ports()
    process = start({"parts": 3, "cameras": ("127.0.32.2", "127.0.32.3"), "rest_port": rest, "modbus_port": modbus}, True)
    try:
        read_until(process, "cameras")
        time.sleep(0.5)
        children = psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        assert process.wait(10) == 0
        assert not psutil.wait_procs(children, timeout=1)[1]
    finally:
        process.kill()
        process.communicate()
