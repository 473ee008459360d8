"""Reads a cell file; an error names file, line, key and what is allowed."""

import json
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from binpick.errors import SettingsError
from binpick.settings import shape
from binpick.settings.cell import Cell
from binpick.settings.recipe import Recipe
from binpick.settings.shape import Mesh
from binpick.settings.tool import Tool


def load(path: Path) -> Cell:
    """The cell of a file, relative paths resolved against the file's folder. Raises SettingsError."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: the cell file cannot be read: {getattr(error, 'strerror', error)}") from error
    cell = parse(text, str(path))
    changes: dict[str, Any] = {"rig": path.parent / cell.rig, "tools": tuple(_shaped(tool, path.parent) for tool in cell.tools)}
    if cell.cameras.backend == "files":
        changes["cameras"] = cell.cameras.model_copy(
            update={"left": path.parent / cell.cameras.left, "right": path.parent / cell.cameras.right})
    changes["recipes"] = tuple(_beside(recipe, path.parent) for recipe in cell.recipes)
    return cell.model_copy(update=changes)


def _beside(recipe: Recipe, folder: Path) -> Recipe:
    """The recipe with its mesh's path resolved against a folder."""
    if recipe.mesh is None:
        return recipe
    return recipe.model_copy(update={"mesh": recipe.mesh.model_copy(update={"file": folder / recipe.mesh.file})})


def _shaped(tool: Tool, folder: Path) -> Tool:
    """The tool with the meshes of its bodies read."""
    if not any(isinstance(body, Mesh) for body in tool.bodies):
        return tool
    bodies = tuple(shape.read(body, folder) if isinstance(body, Mesh) else body for body in tool.bodies)
    return tool.model_copy(update={"bodies": bodies})


def parse(text: str, name: str) -> Cell:
    """The cell of a YAML text; `name` stands in error messages. Raises SettingsError."""
    try:
        document = yaml.safe_load(text)
        tree = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{name}:{mark.line + 1}" if mark else name
        raise SettingsError(f"{where}: not YAML: {getattr(error, 'problem', error)}") from error
    if not isinstance(document, dict):
        raise SettingsError(f"{name}: a cell file is a mapping with at least `bin:`; see deploy/cell.yaml")
    try:
        return Cell.model_validate(document)
    except ValidationError as error:
        found = error.errors()
        # a list whose item is wrong is also reported as too short: say the cause only
        causes = [e for e in found if e["type"] != "too_short" or not any(o["loc"][:len(e["loc"])] == e["loc"] != o["loc"]
                                                                          for o in found)]
        raise SettingsError("; ".join(_say(name, tree, item) for item in causes[:3])) from error


SENTENCES = {"extra_forbidden": "unknown key", "union_tag_not_found": "say which kind it is: `backend:` or `shape:` is missing"}


def _say(name: str, tree: yaml.Node | None, item: Any) -> str:
    loc = [part for part in item["loc"] if part not in ("aravis", "files", "box", "cylinder", "mesh", "suction", "two_finger")]
    key = ".".join(str(part) for part in loc)
    message = SENTENCES.get(item["type"], str(item["msg"]))
    given = f" (it is {item['input']!r})" if isinstance(item.get("input"), int | float | str) else ""
    return f"{name}:{_line(tree, loc)}: {key + ': ' if key else ''}{message}{given}"


def _line(node: yaml.Node | None, loc: list[Any]) -> int:
    """The line of the deepest node of `loc` that the file has; `bins.0` is also a single `bin`."""
    line = node.start_mark.line + 1 if node is not None else 1
    while loc and node is not None:
        head, loc = loc[0], loc[1:]
        child: yaml.Node | None = None
        if isinstance(node, yaml.MappingNode):
            singles = {"bins": "bin", "tools": "gripper"}
            for key, value in node.value:
                if key.value == str(head):
                    line, child = key.start_mark.line + 1, value
                elif key.value == singles.get(str(head)):
                    line, child, loc = key.start_mark.line + 1, value, loc[1:]
        elif isinstance(node, yaml.SequenceNode) and isinstance(head, int) and head < len(node.value):
            child = node.value[head]
            line = child.start_mark.line + 1
        node = child
    return line


def schema() -> str:
    """The cell file's JSON schema, as `binpick schema` prints it."""
    return json.dumps(Cell.model_json_schema(), indent=1) + "\n"
