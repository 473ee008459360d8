"""The daemon is killed in the middle of calibrating: what it said to be done is done, and nothing else."""

import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
import yaml

from binpick import geometry
from binpick import rig as rig_file
from binpick.cell.rigs import Rigs
from binpick.rig import Rig
from binpick.rigcheck import board as boards

BOARD = "charuco:6x4:0.03"
SIZE = (480, 320)
EYE = np.eye(4).tolist()


def rig(**changes: object) -> Rig:
    K = ((500.0, 0.0, 240.0), (0.0, 500.0, 160.0), (0.0, 0.0, 1.0))
    right = geometry.translation(-0.08, 0.0, 0.0).tolist()
    return Rig.model_validate({"image_size_px": SIZE, "cameras": [
        {"name": name, "K": K, "distortion": (0, 0, 0, 0), "T_cam_rig": T} for name, T in (("left", EYE), ("right", right))],
        **changes})


def cell_folder(folder: Path) -> int:
    """A cell whose cameras are two pictures of a board that faces them; its REST port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    sheet = boards.parse(BOARD).charuco.generateImage((280, 200), marginSize=0)
    for name, shift in (("left", 0), ("right", -40)):
        image = np.full(SIZE[::-1], 200, np.uint8)
        image[60:260, 120 + shift:400 + shift] = sheet // 255 * 190 + 10
        cv2.imwrite(str(folder / f"{name}.png"), image)
    (folder / "rig.json").write_bytes(rig_file.dump(rig()))
    (folder / "cell.yaml").write_text(yaml.safe_dump({
        "bin": {"inner_size_m": [0.3, 0.2, 0.1], "pose": {"position_m": [0, 0, 0.6]}}, "control": "rest",
        "cameras": {"backend": "files", "left": "left.png", "right": "right.png"},
        "publish": {"rest": {"port": port}, "modbus": None}, "timeout_ms": 30000,
        "calibration": {"directory": str(folder / "state"), "board": BOARD}}), encoding="utf-8")
    return port


@contextmanager
def daemon(folder: Path, port: int) -> Iterator[tuple[httpx.Client, subprocess.Popen[str]]]:
    """`binpick run` once it serves; killed at the end, whatever it does."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTEST_CURRENT_TEST"}
    process = subprocess.Popen([sys.executable, "-m", "binpick", "run", "--cell", str(folder / "cell.yaml")], text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, env=environment)
    try:
        assert process.stdout is not None
        said = []
        for line in process.stdout:
            said.append(line)
            if line.startswith("binpick is up"):
                break
        else:
            pytest.fail(f"the daemon ended with {process.wait()}: {''.join(said)}")
        with httpx.Client(base_url=f"http://127.0.0.1:{port}/v1", timeout=60) as client:
            while client.get("/health").json()["ready"] is False:
                pass
            yield client, process
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def activated(client: httpx.Client, version: int) -> int:
    """What the cell says that it runs on after a version was activated."""
    return int(client.post("/calibration/activate", json={"version": version}).json()["active"]["version"])


@pytest.mark.slow
def test_what_was_answered_survives_a_kill_and_the_next_start_says_which_rig_it_runs_on(tmp_path: Path) -> None:
    port = cell_folder(tmp_path)
    rigs = Rigs(tmp_path / "state", tmp_path / "rig.json", rig())
    assert [rigs.add(rig(T_base_rig=geometry.translation(x, 0.0, 0.0).tolist())) for x in (0.5, 0.6)] == [2, 3]
    with daemon(tmp_path, port) as (client, _):
        assert client.get("/calibration").json()["active"]["version"] == 1
        taken = client.post("/calibration/samples", json={})
        assert taken.status_code == 201, taken.text
        assert [one["found"] for one in taken.json()["sample"]["sightings"]] == [True, True]
        assert activated(client, 2) == 2
    answered: list[int] = []
    with daemon(tmp_path, port) as (client, process):      # killed as soon as it had answered
        state = client.get("/calibration").json()
        assert (state["active"]["version"], state["samples"]) == (2, 1)
        assert client.get("/health").json()["rig"].startswith("version 2, ")
        killer = threading.Timer(0.3, process.kill)
        killer.start()
        with suppress(httpx.HTTPError):      # changed over and over until it dies in the middle
            answered.extend(activated(client, version) for version in itertools.cycle((3, 1, 2)))
        killer.join()
    assert len(answered) > 1
    with daemon(tmp_path, port) as (client, process):
        state = client.get("/calibration").json()
        following = {1: 2, 2: 3, 3: 1}
        assert state["active"]["version"] in (answered[-1], following[answered[-1]])
        assert [one["version"] for one in state["versions"]] == [1, 2, 3]
        assert state["samples"] == 1
        threading.Timer(0.05, process.kill).start()
        with suppress(httpx.HTTPError):      # killed while a sample is taken: it is there whole, or not at all
            while client.post("/calibration/samples", json={}):
                pass
    with daemon(tmp_path, port) as (client, _):
        listed = client.get("/calibration/samples").json()
        assert listed["damaged"] == {}
        assert [one["id"] for one in listed["samples"]] == list(range(1, len(listed["samples"]) + 1))
        assert all(client.get(f"/calibration/samples/{one['id']}/right.png").status_code == 200 for one in listed["samples"])
