"""The viewfinder: what capture has covered and what it lacks, drawn in the terminal; plain lines where there is none."""

from types import TracebackType

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from binpick_calib.capture import Step

SHADES = ("░░░", "▒▒▒", "▓▓▓", "███")
"""No view, one, two, three and more show the board in this cell."""
OUTSIDE = " · "
LISTED = 6
ARROWS = {"left": "◀", "right": "▶", "upper": "▲", "lower": "▼"}


class Viewfinder:
    """Shows each step. In a terminal one picture that changes, else a line whenever something new is said."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, refresh_per_second=4) if console.is_terminal else None
        self._last = ""

    def __enter__(self) -> "Viewfinder":
        if self._live is not None:
            self._live.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._live is not None:
            self._live.__exit__(kind, error, trace)

    def show(self, step: Step) -> None:
        """What became of one moment."""
        if self._live is not None:
            self._live.update(picture(step))
            return
        views = len(step.coverage.views)
        line = (f"view {views} of {step.coverage.wanted}: {step.said}" if step.taken
                else step.said if step.waits else f"not taken: {step.said}")
        if line != self._last:
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)
            self._last = line


def picture(step: Step) -> RenderableType:
    """Maps of the images, tilts, distances, what is missing, and why the last view was taken or not."""
    told = step.coverage.summary
    maps = Table.grid(padding=(0, 4))
    maps.add_row(*(Text(name, style="bold") for name in told["cells"]))
    maps.add_row(*(_map(rows) for rows in told["cells"].values()))
    tilts = Text("tilted, nearer side  ")
    for side, views in told["tilts"].items():
        tilts.append(f"{ARROWS[side]} {side} {views}   ", style="green" if views else "yellow")
    lines: list[RenderableType] = [maps, Text(), tilts, Text(f"nearest / farthest   {told['range']:.2f}")]
    if told["missing"]:
        lines += [Text(), Text("Still missing:", style="bold"), *(Text(f"  {what}") for what in told["missing"][:LISTED])]
        if len(told["missing"]) > LISTED:
            lines.append(Text(f"  and {len(told['missing']) - LISTED} more"))
    said = f"view {told['views']} taken: {step.said}" if step.taken else step.said
    last = Text(said, style="bold green" if step.taken else "yellow")
    return Group(Text(f"Views: {told['views']} of {told['wanted']}. Ctrl-C ends; what was taken stays.", style="bold"), Text(),
                 *lines, Text(), last)


def _map(rows: list[list[int | None]]) -> Text:
    """An image's cells, each three characters wide."""
    drawn = Text()
    for row in rows:
        for views in row:
            if views is None:
                drawn.append(OUTSIDE, style="dim")
            else:
                drawn.append(SHADES[min(views, len(SHADES) - 1)], style="green" if views else "yellow")
        drawn.append("\n")
    return drawn
