"""What stands beside the product is true: example cell file, schema, pins, and the image's system packages."""

import re
from importlib import metadata
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from binpick import settings
from binpick.sim import exam

ROOT = Path(__file__).parents[2]


def test_the_example_cell_file_is_real_cameras_over_the_demos_bin() -> None:
    cell = settings.load(ROOT / "deploy/cell.yaml")
    assert cell.cameras.backend == "aravis"
    assert cell.bins[0].inner_size_m == exam.setup("A").bin_size_m
    assert cell.rig == ROOT / "deploy/rig.json"
    assert settings.resolve(cell).recipe.frame == "camera"    # works before there is a hand-eye calibration
    assert cell.tools[0].bodies == settings.SuctionTool().bodies


def test_the_schema_is_current() -> None:
    assert (ROOT / "deploy/cell.schema.json").read_text(encoding="utf-8") == settings.schema(), "run `make schema`"


def needed(name: str, extras: frozenset[str], seen: set[tuple[str, str]]) -> None:
    """Adds every (distribution, extra) that an installation of `name` reaches; "" is the distribution itself."""
    new = {(canonicalize_name(name), extra) for extra in extras | {""}} - seen
    if not new:
        return
    seen |= new
    try:
        requirements = metadata.distribution(name).requires or []
    except metadata.PackageNotFoundError:
        return    # of another platform
    for requirement in map(Requirement, requirements):
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for _, extra in new):
            needed(requirement.name, frozenset(requirement.extras), seen)


def test_constraints_pin_all_that_is_installed_and_nothing_else() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    pins = {canonicalize_name(line.split("==")[0]) for line in lines}
    seen: set[tuple[str, str]] = set()
    for root in ("hatchling", "editables", "binpick"):
        needed(root, frozenset({"sim", "dev"} if root == "binpick" else ()), seen)
    names = {name for name, _ in seen} - {"binpick"}
    elsewhere = {"open3d"}    # machines that open3d-cpu has no wheels for
    assert names - pins == set(), "pin these in constraints.txt"
    assert pins - names == elsewhere, "nothing needs these pins"


def test_the_image_has_the_system_packages_of_the_makefile() -> None:
    found = re.search(r"^SYSTEM := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert found
    assert set(found[1].split()) <= set((ROOT / "deploy/Dockerfile").read_text(encoding="utf-8").split())


def test_compose_starts_the_example_cell_by_default_and_the_demo_on_request() -> None:
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
    assert services["demo"]["profiles"] == ["demo"]
    assert "profiles" not in services["cell"]
    assert services["cell"]["command"] == ["run", "--cell", "/etc/binpick/cell.yaml"]
    assert "./deploy:/etc/binpick:ro" in services["cell"]["volumes"]
