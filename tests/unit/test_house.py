"""The house's own rules: small modules, and a line of DECISIONS for each that says its idea."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEADING = "## Modules\n\n"
MODULES = sorted(path for source in ("service", "calib") for path in (ROOT / source).rglob("*.py"))


def name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_a_module_is_small_and_says_its_idea(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 300
    assert ast.get_docstring(ast.parse(text)), "the first line says the idea"


def modules_section() -> str:
    """What DECISIONS says under its last heading."""
    ideas = {name(path): str(ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))).split("\n")[0] for path in MODULES}
    return "".join(f"- `{module or 'binpick'}`: {idea}\n" for module, idea in sorted(ideas.items()))


def test_decisions_list_every_module_with_its_idea() -> None:
    decisions = (ROOT / "DECISIONS.md").read_text(encoding="utf-8")
    assert decisions.split(HEADING)[1] == modules_section(), "run `make schema`"


if __name__ == "__main__":
    page = ROOT / "DECISIONS.md"
    page.write_text(page.read_text(encoding="utf-8").split(HEADING)[0] + HEADING + modules_section(), encoding="utf-8")
