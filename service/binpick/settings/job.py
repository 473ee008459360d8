"""What one cycle works by: the recipe, bin and tools a request resolves to."""

import hashlib
from typing import Annotated, TypeVar

from pydantic import Field

from binpick.errors import UnknownItem
from binpick.settings.base import Strict
from binpick.settings.cell import Cell
from binpick.settings.recipe import Bin, Recipe
from binpick.settings.tool import SuctionTool, Tool, TwoFingerTool

Item = TypeVar("Item", Recipe, Bin, SuctionTool | TwoFingerTool)


class Job(Strict):
    """A recipe with its bin and tools in place of their numbers; all of the settings that the pipeline reads."""

    recipe: Recipe
    bin: Bin
    tools: Annotated[tuple[Tool, ...], Field(min_length=1)]

    @property
    def tool(self) -> Tool:
        """The first of the tools."""
        return self.tools[0]

    def tool_numbered(self, number: int) -> Tool:
        """One of the tools. Raises UnknownItem."""
        return _find(self.tools, number, "tool")

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
    wanted_tools = (tool,) if tool else chosen.tools or (cell.tools[0].number,)
    return Job(
        recipe=chosen,
        bin=_find(cell.bins, wanted_bin, "bin") if wanted_bin else cell.bins[0],
        tools=tuple(_find(cell.tools, number, "tool") for number in wanted_tools),
    )


def _find(items: tuple[Item, ...], number: int, kind: str) -> Item:
    for item in items:
        if item.number == number:
            return item
    known = ", ".join(str(item.number) for item in items)
    raise UnknownItem(f"there is no {kind} {number}; the cell file has {known}")
