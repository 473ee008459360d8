"""`binpick sim` as a person uses it: cameras in one terminal, what befalls them from another."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from binpick import settings
from binpick.cli import app
from binpick.errors import InputError
from binpick.sim.gige import faults

pytestmark = pytest.mark.gige


def tell(*words: str) -> list[dict[str, object]]:
    done = CliRunner().invoke(app, ["sim", *words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_cameras_run_and_hear_of_their_faults(tmp_path: Path, gige_addresses: tuple[str, str]) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "PYTEST_CURRENT_TEST"}
    command = [sys.executable, "-m", "binpick", "sim", "--out", str(tmp_path), "--numbered", "--heads", "3", "--at",
               gige_addresses[0], "--fault", "power=off@third"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as running:
        assert running.stdout is not None
        assert "binpick run --cell" in running.stdout.readline()
        cell = settings.load(tmp_path / "cell.yaml")
        assert cell.cameras.right.address == gige_addresses[1]
        at = ["--at", gige_addresses[0]]
        assert [(head["name"], head["powered"]) for head in tell(*at)] == [("left", True), ("right", True), ("third", False)]
        assert [head["powered"] for head in tell(*at, "--fault", "power=off@left", "--fault", "clear@third")] == [
            False, True, True]
        with pytest.raises(InputError, match="no fault 'rust'"):
            tell(*at, "--fault", "rust")
        running.terminate()


def test_the_help_of_faults_lists_every_one() -> None:
    done = CliRunner().invoke(app, ["sim", "--fault", "help"])
    assert [line.split()[0] for line in done.stdout.splitlines()] == list(faults.FAULTS)


def test_an_address_that_is_none() -> None:
    with pytest.raises(InputError, match="--at"):
        tell("--out", "out", "--numbered", "--at", "left")
