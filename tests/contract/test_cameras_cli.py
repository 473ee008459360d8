"""`binpick cameras` and `binpick check --host` against simulated cameras: real packets, as on the first day with real ones."""

import json
import os
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from binpick import cli, demo
from binpick.camera import backends, probe
from binpick.errors import CameraError, CameraLost
from binpick.settings.cell import AravisCameras, CameraAddress
from binpick.sim.gige import GigePair

NOBODY = "127.0.250.251"
CELL = """
bin:
  inner_size_m: [0.30, 0.20, 0.10]
  pose: {{frame: camera, position_m: [0.0, 0.0, 1.0], rotvec_rad: [3.14159265358979, 0, 0]}}
cameras: {{backend: aravis, left: {{{}}}, right: {{{}}}}}
"""
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def gige(gige_addresses: tuple[str, str]) -> Iterator[GigePair]:
    serials = (f"LC{os.getpid()}", f"RC{os.getpid()}")
    with GigePair(lambda _index, _light, _shot: np.zeros((40, 64), np.uint8), gige_addresses, (64, 40), serials) as pair:
        yield pair


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """call(arguments): exit code, stdout, stderr of `binpick`."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["binpick", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        told = capsys.readouterr()
        return int(ended.value.code or 0), told.out, told.err

    return run


@pytest.fixture
def discoverable(gige: GigePair) -> None:
    """They answer broadcasts a moment after they answer their address."""
    serials = {identity.serial for identity in gige.identities}
    assert any(serials <= {found.serial for found in backends.discover()} for _ in range(5))


@pytest.fixture
def held(gige: GigePair) -> Iterator[None]:
    """The left camera, controlled by somebody else."""
    left, right = (CameraAddress(address=identity.address) for identity in gige.identities)
    camera, _ = backends.make(AravisCameras(left=left, right=right))
    camera.open(time.monotonic_ns() + int(5e9))
    yield
    camera.close()


@pytest.mark.gige
def test_list_tells_where_a_camera_is_and_who_controls_it(gige: GigePair, discoverable: None, held: None, call: Call) -> None:
    code, out, _ = call("cameras", "list", "--json")
    rows = {row["serial"]: row for row in json.loads(out)}       # of others too, that run on this machine
    left, right = (rows[identity.serial] for identity in gige.identities)
    assert code == 0
    assert {key: right[key] for key in ("vendor", "model", "port", "control")} == {
        "vendor": "Allied Vision", "model": "Alvium G1-240m", "port": "lo", "control": "free"}
    assert right["address"] == gige.identities[1].address
    assert len(right["mac"].split(":")) == 6
    assert left["control"] == "held by another program"
    code, out, _ = call("cameras", "list")
    assert code == 0
    assert out.splitlines()[0].split() == ["address", "serial", "vendor", "model", "mac", "port", "control"]
    assert gige.identities[0].serial in out


@pytest.mark.gige
def test_values_are_those_of_the_camera_and_grep_picks_some(gige: GigePair, call: Call) -> None:
    address = gige.identities[0].address
    code, out, _ = call("cameras", "values", address, "--grep", "^(exposuretime|TriggerMode|Width|TriggerSoftware)$")
    assert code == 0
    title, *lines = out.strip().splitlines()
    assert title == f"Alvium G1-240m {gige.identities[0].serial} at {address}"
    assert [line.split() for line in lines] == [
        ["feature", "access", "value", "may", "be"], ["Width", "RO", "64", "px"],
        ["TriggerMode", "RW", "Off", "Off", "|", "On"], ["TriggerSoftware", "WO"],
        ["ExposureTime", "RW", "5000", "us", "20", "to", "10000000"]]
    assert probe.controller(address) == ""          # let go at once, so that a daemon may take it


@pytest.mark.gige
def test_a_camera_that_another_program_controls_is_read_and_not_disturbed(gige: GigePair, held: None, call: Call) -> None:
    address = gige.identities[0].address
    code, out, _ = call("cameras", "values", address, "--grep", "TriggerMode")
    assert code == 0
    assert "controlled by another program" in out
    assert out.splitlines()[2].split() == ["TriggerMode", "RW", "On", "Off", "|", "On"]          # as its controller has set it
    assert probe.controller(address) == "another program"


@pytest.mark.gige
def test_dump_is_one_file_with_all_that_is_asked_for(gige: GigePair, call: Call, tmp_path: Path) -> None:
    address, path = gige.identities[1].address, tmp_path / "cameras.zip"
    code, out, err = call("cameras", "dump", address, "--out", str(path))
    assert (code, out.split(" (")[0]) == (0, f"written: {path}")
    assert f"1 of 1: reading {address}" in err
    with zipfile.ZipFile(path) as archive:
        texts = {name.removeprefix("cameras/"): archive.read(name).decode() for name in archive.namelist()}
    assert set(texts) == {"host.json", "versions.json", *(f"{address}/{name}" for name in ("genicam.xml", "values.txt",
                                                                                          "features.json"))}
    assert ElementTree.fromstring(texts[f"{address}/genicam.xml"]).tag.endswith("RegisterDescription")     # whole, no more
    facts = json.loads(texts[f"{address}/features.json"])
    assert facts["registers"]["0x0938"] == f"{3000:#010x}"      # the heartbeat timeout
    features = {feature["name"]: feature for feature in facts["features"]}
    assert features["ExposureTime"] == {
        "name": "ExposureTime", "category": "AcquisitionControl", "kind": "Float", "access": "RW", "value": "5000",
        "unit": "us", "minimum": "20", "maximum": "10000000", "step": "", "entries": [], "trouble": ""}
    assert features["DeviceSerialNumber"]["value"] == gige.identities[1].serial
    assert json.loads(texts["host.json"])["kernel"]
    versions = json.loads(texts["versions.json"])
    assert versions["aravis"].startswith("0.8.")
    assert {"binpick", "python", "numpy"} <= set(versions)


@pytest.mark.gige
def test_dump_says_what_it_lacks(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "cameras.zip"
    code, out, err = call("cameras", "dump", NOBODY, "--out", str(path))
    assert code == 3
    assert "written:" in out
    assert f"could not be read of {NOBODY}" in err
    with zipfile.ZipFile(path) as archive:
        assert "no camera answers" in archive.read(f"cameras/{NOBODY}/error.txt").decode()
    code, _, err = call("cameras", "dump", NOBODY, "--out", str(tmp_path / "nowhere" / "cameras.zip"))
    assert (code, err.splitlines()[-1].endswith("cannot be written: No such file or directory")) == (2, True)


@pytest.mark.gige
def test_a_wrong_address_and_a_wrong_pattern_are_one_line(call: Call) -> None:
    code, _, err = call("cameras", "values", NOBODY)
    assert code == 3
    assert err.startswith(f"binpick: no camera answers at {NOBODY}: `binpick cameras list` shows")
    assert call("cameras", "values", NOBODY, "--grep", "(")[0] == 2


@pytest.mark.gige
def test_a_camera_that_dies_while_it_is_read_is_lost_in_time(gige: GigePair, monkeypatch: pytest.MonkeyPatch,
                                                              clock: Callable[[], float]) -> None:
    """One driver call's seconds, not those of every feature that is left."""
    from binpick.camera.aravis import inventory

    read = inventory._feature

    def dying(*arguments: object) -> object:
        gige.kill(0)
        return read(*arguments)

    monkeypatch.setattr(inventory, "_feature", dying)
    start = clock()
    with pytest.raises(CameraLost, match="stopped answering"):
        backends.describe(gige.identities[0].address)
    assert clock() - start < 15


@pytest.mark.gige
def test_check_looks_at_the_host_alone_and_finds_a_camera_by_its_serial_number(gige: GigePair, discoverable: None,
                                                                               call: Call, tmp_path: Path) -> None:
    left, right = gige.identities
    (tmp_path / "cell.yaml").write_text(CELL.format(f"serial: {left.serial}", f"address: {right.address}"))
    code, out, _ = call("check", "--host", "--json", "--cell", str(tmp_path / "cell.yaml"))
    found = {finding["what"]: finding for finding in json.loads(out)}
    assert found["way to left"]["seen"] == f"{left.address} by lo"
    assert found["way to right"]["seen"] == f"{right.address} by lo"
    assert code == max(finding["exit_code"] for finding in found.values())
    assert {"receive buffer", "firewall", "clock", "processors"} <= set(found)
    assert not {"cell file", "publish.rest", "cameras"} & set(found)


@pytest.mark.gige
def test_check_of_a_cell_whose_cameras_are_away_points_to_the_host(call: Call, tmp_path: Path, free_port: int) -> None:
    demo.files(demo.Plan(cameras=(NOBODY, NOBODY), rest_port=free_port, modbus_port=free_port), tmp_path)
    code, out, _ = call("check", "--json", "--cell", str(tmp_path / "cell.yaml"))
    cameras = json.loads(out)[-1]
    assert (code, cameras["what"]) == (3, "cameras")
    assert cameras["command"] == f"binpick check --host --cell {tmp_path / 'cell.yaml'}"


def test_check_looks_at_the_way_to_every_camera_and_says_why_it_cannot_search(
        call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def search() -> None:
        raise CameraError("Aravis is not installed")

    monkeypatch.setattr(backends, "discover", search)
    cell = CELL.format("address: 203.0.113.7", "serial: AB12")
    (tmp_path / "cell.yaml").write_text(cell.replace("aravis,", "aravis, more: [{address: camera-3}],"))
    code, out, _ = call("check", "--host", "--json", "--cell", str(tmp_path / "cell.yaml"))
    found = {finding["what"]: finding for finding in json.loads(out)}
    assert (code, found["search by serial number"]["fault"]) == (3, "Aravis is not installed")
    assert "203.0.113.7" in found["way to left"]["seen"]
    assert found["way to right"]["warning"].startswith("unknown")
    assert found["way to third"]["exit_code"] == 2


def test_check_prints_the_commands_whole_below_the_findings(call: Call, tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(CELL.format("address: camera-1", "address: 203.0.113.7"))
    code, out, _ = call("check", "--host", "--cell", str(tmp_path / "cell.yaml"))
    table, commands = out.split("Commands, in the order of the lines above:")
    assert code == 2
    assert "FAIL  way to left" in table
    assert "sudo ip addr add 203.0.113.1/24 dev " in commands
    assert all(line.startswith("  ") for line in commands.strip("\n").splitlines())


def test_help_says_what_each_is_for(call: Call) -> None:
    assert all(word in call("cameras", "--help")[1] for word in ("list", "values", "dump", "disturbs no daemon"))
    assert "--grep" in call("cameras", "values", "--help")[1]
    assert "no images" in call("cameras", "dump", "--help")[1]
    assert "--host" in call("check", "--help")[1]
