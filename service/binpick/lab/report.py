"""The bench as a table for people and as JSON for machines; the exam of `binpick bench`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

from binpick.lab import exam
from binpick.lab.grasps import Answer, Scene
from binpick.lab.stereo import DepthScore
from binpick.sim import exam as tables
from binpick.sim import score


def figures(world: str, scenes: Sequence[Scene]) -> dict[str, Any]:
    """All figures of a run."""
    book = [s.textbook for s in scenes if s.textbook is not None]
    windowed = [s.textbook_window for s in scenes if s.textbook_window is not None]
    ours = _answers([s.ours for s in scenes])
    rows = {"ours": ours} | ({"textbook": _answers(book), "textbook, our window": _answers(windowed)} if book else {})
    for row in rows.values():
        row["times_ours"] = round(row["seconds_p50"] / ours["seconds_p50"], 2)
    return {
        "exam_sha256": tables.sha256(),
        "world": world,
        "seeds": [s.seed for s in scenes],
        "plain_sgbm": _depth([s.plain for s in scenes]),
        "rows": rows,
        "codes": [s.code for s in scenes],
        "stages_ms": {k: round(float(np.median([s.stages_ms[k] for s in scenes])), 1) for k in scenes[0].stages_ms},
    }


def _depth(scores: Sequence[DepthScore]) -> dict[str, float]:
    """Pooled over the scenes by their number of part pixels; the median is the mean of the scenes' medians."""
    weight = np.array([s.pixels for s in scores], dtype=float)
    pooled = {
        k: float(np.average([getattr(s, k) for s in scores], weights=weight)) for k in ("bad1", "bad2", "median_px", "density")
    }
    return {k: round(v, 4) for k, v in pooled.items()}


def _answers(answers: Sequence[Answer]) -> dict[str, Any]:
    first = sum(a.top_is_good for a in answers)
    five = [ok for a in answers for ok in a.good[:5]]
    seconds = [t for a in answers for t in a.seconds]
    low, high = exam.wilson(first, len(answers))
    return {
        **_depth([a.depth for a in answers]),
        "first_good": first,
        "scenes": len(answers),
        "p_at_1": round(first / len(answers), 3),
        "p_at_1_interval": [round(low, 3), round(high, 3)],
        "p_at_5": round(sum(five) / max(len(five), 1), 3),
        "published": len(five),
        "penetration_max_mm": round(1000 * max([p for a in answers for p in a.penetration_m], default=0), 2),
        "collisions": sum(p > score.MAX_PENETRATION_M for a in answers for p in a.penetration_m),
        "cycles": len(seconds),
        "seconds_p50": round(float(np.median(seconds)), 4),
    }


def table(run: dict[str, Any]) -> Group:
    """The same for people; the difficulty row stands first."""
    plain = run["plain_sgbm"]
    depth = Table(
        "plain SGBM on part pixels",
        "bad-1",
        "bad-2",
        "median |Δd|",
        "density",
        title=f"Exam world {run['world']}, seeds {run['seeds'][0]} to {run['seeds'][-1]}, "
        f"tables {run['exam_sha256'][:12]}",
    )
    depth.add_row(
        "difficulty", f"{plain['bad1']:.1%}", f"{plain['bad2']:.1%}", f"{plain['median_px']:.3f} px", f"{plain['density']:.1%}"
    )
    rows = Table(
        "pipeline", "time p50", "× ours", "density", "bad-1", "bad-2", "median", "P@1 (95 %)", "P@5", "worst penetration"
    )
    for name, row in run["rows"].items():
        low, high = row["p_at_1_interval"]
        rows.add_row(
            name,
            f"{row['seconds_p50']:.2f} s",
            f"{row['times_ours']:.1f}",
            f"{row['density']:.1%}",
            f"{row['bad1']:.1%}",
            f"{row['bad2']:.1%}",
            f"{row['median_px']:.2f} px",
            f"{row['first_good']}/{row['scenes']} ({low:.2f}-{high:.2f})",
            f"{row['p_at_5']:.2f} of {row['published']}",
            f"{row['penetration_max_mm']:.1f} mm",
        )
    stages = "stages p50, ms: " + "  ".join(f"{k} {v:g}" for k, v in run["stages_ms"].items())
    return Group(depth, rows, stages)
