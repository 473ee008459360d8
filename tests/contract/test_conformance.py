"""Aravis' own conformance test, a foreign GigE Vision client, finds nothing wrong with the simulated pair."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from binpick.sim.gige import GigePair

ROOT = Path(__file__).parents[2]
LINK_MBPS = 900.0
"""A real camera's wire: the tool leaves its socket at the kernel's small default, which a faster one overruns."""
SIZE = (400, 252)
"""Such an image fits that socket whole, so that a busy machine, where the tool waits for a core, does not lose packets."""
COLOUR = re.compile(r"\x1b\[[\d;]*m")
SECTIONS = {"Genicam", "Properties", "MultipleAcquisitionA", "SingleAcquisition", "SoftwareTrigger", "MultipleAcquisitionB",
            "Multipart", "Chunks", "GigEVision"}


@pytest.fixture(scope="module")
def tool() -> str:
    """`make install-test` unpacks it."""
    path = os.environ.get("ARV_TEST") or shutil.which("arv-test-0.8") or str(ROOT / ".venv/bin/arv-test-0.8")
    assert Path(path).exists(), "arv-test-0.8 is missing: run deploy/install-conformance .venv/bin"
    return path


@pytest.mark.gige
@pytest.mark.slow
def test_the_conformance_test_of_aravis_finds_no_failure(tool: str, gige_addresses: tuple[str, str]) -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, *SIZE[::-1]), np.uint8)
    serial = f"CONF{os.getpid()}"
    with GigePair(lambda index, _light, _shot: images[index], gige_addresses, SIZE, (f"{serial}-L", f"{serial}-R")) as pair:
        for head in pair.heads:
            pair.change(head, link_mbps=LINK_MBPS)
        done = subprocess.run([tool, "-n", f"*{serial}-?", "-c", str(Path(__file__).with_name("conformance.ini"))],
                              capture_output=True, text=True, timeout=60, check=True)
    report = COLOUR.sub("", done.stdout)
    assert report.count("Testing 'Allied Vision:Alvium G1-240m'") == 2, report
    results = re.findall(r"^(\w+):\S+ +(\w+)", report, re.MULTILINE)
    assert {section for section, _ in results} == SECTIONS, report
    assert {verdict for _, verdict in results} == {"SUCCESS", "IGNORED"}, report
    assert [verdict for _, verdict in results].count("IGNORED") == 2, report         # the schema, of each
