"""The views panel: where samples have shown the board, and what is missing; in the grasps' place while they are taken."""

from html import escape

from binpick.calibration import Progress
from binpick.result import Snapshot

LISTED = 4
"""Missing things shown; when they are there, the next ones are."""


def panel(snapshot: Snapshot) -> str:
    """Maps of the images and what is missing; "" when the last cycle looked at no board."""
    answer = snapshot.latest.sample if snapshot.latest is not None else None
    if answer is None:
        return ""
    progress, sample = answer.progress, answer.sample
    told = progress.coverage
    title = f"Views of the board: {told['views']} of {told['wanted']}"
    tone = "good" if sample.useful else "warn"
    return (f'<div class="card views"><h2>{title}<i class="{tone}">{escape(sample.sentence)}</i></h2>'
            f'<div class="maps">{"".join(_map(name, rows) for name, rows in told["cells"].items())}</div>'
            f"{_missing(progress)}</div>")


def _map(name: str, rows: list[list[int | None]]) -> str:
    cells = "".join(f'<i class="{_tone(views)}">{views or ""}</i>' for row in rows for views in row)
    columns = f"--columns:{len(rows[0])}"
    return f'<figure><figcaption>{escape(name)}</figcaption><div class="cells" style="{columns}">{cells}</div></figure>'


def _tone(views: int | None) -> str:
    """`out`: another camera does not look there, so that nothing is asked for."""
    return "out" if views is None else "seen" if views else "open"


def _missing(progress: Progress) -> str:
    if progress.enough:
        return '<p class="good">Enough: the next step is to solve.</p>'
    listed = "".join(f"<p>{escape(what)}</p>" for what in progress.missing[:LISTED])
    rest = len(progress.missing) - LISTED
    return f"<small>still missing</small>{listed}" + (f"<small>and {rest} more</small>" if rest > 0 else "")
