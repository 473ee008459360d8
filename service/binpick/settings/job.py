"""What one cycle works by: the recipe, bin and tool a request resolves to."""

import hashlib
from typing import TypeVar

from binpick.errors import UnknownItem
from binpick.settings.base import Strict
from binpick.settings.cell import Cell
from binpick.settings.recipe import Bin, Recipe
from binpick.settings.tool import Tool

Item = TypeVar("Item", Recipe, Bin, Tool)


class Job(Strict):
    """A recipe with its bin and tool in place of their numbers; all of the settings that the pipeline reads."""

    recipe: Recipe
    bin: Bin
    tool: Tool

    @property
    def sha256(self) -> str:
        """Names these settings in a result."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    @property
    def recipe_sha256(self) -> str:
        """Names the recipe alone."""
        return hashlib.sha256(self.recipe.model_dump_json().encode()).hexdigest()


def resolve(cell: Cell, recipe: int = 0, bin_number: int = 0, tool: int = 0) -> Job:
    """The job of a request's numbers; 0 means the recipe's own, or the first. Raises UnknownItem."""
    chosen = _find(cell.recipes, recipe, "recipe") if recipe else cell.recipes[0]
    wanted_bin = bin_number or chosen.bin
    wanted_tool = tool or (chosen.tools[0] if chosen.tools else 0)
    return Job(
        recipe=chosen,
        bin=_find(cell.bins, wanted_bin, "bin") if wanted_bin else cell.bins[0],
        tool=_find(cell.tools, wanted_tool, "tool") if wanted_tool else cell.tools[0],
    )


def _find(items: tuple[Item, ...], number: int, kind: str) -> Item:
    for item in items:
        if item.number == number:
            return item
    known = ", ".join(str(item.number) for item in items)
    raise UnknownItem(f"there is no {kind} {number}; the cell file has {known}")
