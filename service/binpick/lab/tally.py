"""The figures of `binpick bench grasp`, pooled per tool and per kind, as JSON for machines and as tables for people."""

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from rich.console import Group
from rich.table import Table

from binpick.lab import exam, offsets, parts
from binpick.lab.parts import PartScore
from binpick.lab.picks import KINDS, METHOD, MIXES, Pick, Sheet, Tried
from binpick.sim import exam as frozen
from binpick.sim import score

STAGES = ("bin", "segment", "grasp", "clearance")
"""What follows depth; their sum is `sum`, the whole computation `cycle`."""
FIRST = 5
OFF = "off: how far a cup's TCP is above the true surface; how much wider than close_m what the fingers hold is"
Figures = dict[str, Any]
Item = TypeVar("Item")


def figures(world: str, count: int, sheets: Sequence[Sheet]) -> Figures:
    """All figures of a run of `count` parts a bin; under `all` the kinds are pooled."""
    tools = {}
    for tool, kinds in KINDS.items():
        tried = {mix: [pick for sheet in sheets if sheet.kinds == mix for pick in sheet.picks if pick.tool == tool]
                 for mix in kinds}
        tools[tool] = {mix: row(tool, picks) for mix, picks in _pooled(tried).items()}
    seen = {mix: [part for sheet in sheets if sheet.kinds == mix for part in sheet.parts] for mix in MIXES}
    return {
        "exam_sha256": frozen.sha256(), "world": world, "parts": count, "seeds": sorted({sheet.seed for sheet in sheets}),
        "tools": tools, "segments": {mix: recall(found) for mix, found in _pooled(seen).items()},
        "methods": _methods(sheets),
    }


def _methods(sheets: Sequence[Sheet]) -> Figures:
    """Every segmenter's recall and first grasps, all kinds pooled, and its median time."""
    tried = [each for sheet in sheets for each in (Tried(METHOD, sheet.parts, sheet.picks), *sheet.others)]
    rows = {}
    for method in dict.fromkeys(each.method for each in tried):
        mine = [each for each in tried if each.method == method]
        picks = [pick for each in mine for pick in each.picks]
        p_at_1 = {tool: row(tool, [pick for pick in picks if pick.tool == tool])["p_at_1"] for tool in KINDS}
        rows[method] = {"segments": recall([part for each in mine for part in each.parts]), "p_at_1": p_at_1,
                        "segment_ms": _stages(picks)["segment"]}
    return rows


def _pooled(groups: dict[str, list[Item]]) -> dict[str, list[Item]]:
    return {**groups, "all": list(itertools.chain(*groups.values()))}


def row(tool: str, picks: Sequence[Pick]) -> Figures:
    """One tool's cycles pooled. A scene without a grasp is a first grasp that is not good; P@5 asks for what was published."""
    five = [grip for pick in picks for grip in pick.grips[:FIRST]]
    depths = [grip.penetration_m for pick in picks for grip in pick.grips]
    return {
        "scenes": len(picks),
        "with_grasp": share(sum(bool(pick.grips) for pick in picks), len(picks)),
        "p_at_1": share(sum(pick.grips[0].ok for pick in picks if pick.grips), len(picks)),
        "p_at_5": share(sum(grip.ok for grip in five), len(five)),
        "collisions": sum(depth > score.MAX_PENETRATION_M for depth in depths),
        "penetration_max_mm": round(1000 * max(depths, default=0.0), 2),
        "codes": {str(code): times for code, times in sorted(Counter(pick.code for pick in picks).items())},
        "sigmas": offsets.within([grip.in_sigmas for pick in picks for grip in pick.grips if grip.ok]),
        "sigma_z": _sigma(picks) if tool == "suction" else None,
        "off_mm": _off(picks),
        "stages_ms": _stages(picks),
    }


def recall(found: Sequence[PartScore]) -> Figures:
    """Parts in plain view that are one segment, at the intersection over union of `parts.HALF`."""
    return share(*parts.recall(found))


def share(good: int, of: int) -> Figures:
    """A share with its 95 % interval, which takes each for itself: several grasps of one scene are less certain than that."""
    low, high = exam.wilson(good, of)
    return {"good": good, "of": of, "share": round(good / of, 3) if of else None, "interval": [round(low, 3), round(high, 3)]}


def _sigma(picks: Sequence[Pick]) -> Figures:
    """How many of the grasps that hold have their TCP within 1 and 2 sigma of the true surface, along the approach."""
    holding = [grip for pick in picks for grip in pick.grips if grip.ok]
    ratios = np.array([abs(grip.off_m) / grip.sigma_z_m for grip in holding])
    within = {f"within_{limit}": share(int((ratios <= limit).sum()), ratios.size) for limit in (1, 2)}
    return {"median_mm": round(1000 * float(np.median([grip.sigma_z_m for grip in holding])), 3) if holding else None, **within}


def _off(picks: Sequence[Pick]) -> Figures:
    """`off_m` of the grasps that hold: the median, and the one furthest from 0, mm."""
    off = np.array([1000 * grip.off_m for pick in picks for grip in pick.grips if grip.ok])
    if not off.size:
        return {"median": None, "worst": None}
    return {"median": round(float(np.median(off)), 2), "worst": round(float(off[np.abs(off).argmax()]), 2)}


def _stages(picks: Sequence[Pick]) -> dict[str, float | None]:
    """Medians in ms over the cycles that came so far."""
    times = [{name: pick.timing_ms[name] for name in STAGES} | {"cycle": pick.timing_ms["compute"]}
             for pick in picks if STAGES[-1] in pick.timing_ms]
    spent = {**{name: [time[name] for time in times] for name in (*STAGES, "cycle")},
             "sum": [sum(time[name] for name in STAGES) for time in times]}
    return {name: round(float(np.median(spent[name])), 1) if times else None for name in (*STAGES, "sum", "cycle")}


def tables(run: Figures) -> Group:
    """A run of `binpick bench grasp`."""
    head = (f"Exam world {run['world']}, {run['parts']} parts, seeds {run['seeds'][0]} to {run['seeds'][-1]}, "
            f"tables {run['exam_sha256'][:12]}")
    grips = Table("tool", "parts", "P@1 (95 %)", "P@5 (95 %)", "with a grasp", "collisions (worst)", "z within 1σ, 2σ",
                  "off (worst)", "codes", title=head, title_justify="left")
    stages = Table("median, ms", "parts", *STAGES, "sum", "cycle")
    for tool, rows in run["tools"].items():
        for mix, each in rows.items():
            grips.add_row(tool, mix, _range(each["p_at_1"]), _range(each["p_at_5"]), _of(each["with_grasp"]),
                          f"{each['collisions']} ({each['penetration_max_mm']:.1f} mm)", _within(each), _off_by(each),
                          " ".join(f"{code}: {times}" for code, times in each["codes"].items()), end_section=mix == "all")
            stages.add_row(tool, mix, *("-" if ms is None else f"{ms:.1f}" for ms in each["stages_ms"].values()),
                           end_section=mix == "all")
    whole = Table(f"parts seen {parts.PLAIN_VIEW:.0%} and more", f"one segment (IoU > {parts.HALF:.1f})", "share (95 %)")
    for mix, found in run["segments"].items():
        whole.add_row(mix, _of(found), percent(found))
    return Group(grips, OFF, offsets.table(run["tools"]), whole, stages, _beside(run["methods"]))


def _beside(methods: Figures) -> Table:
    """The segmenters beside each other."""
    table = Table("segmenter, all kinds", "one segment (95 %)", *(f"P@1 {tool}" for tool in KINDS), "segment, median ms")
    for method, each in methods.items():
        spent = each["segment_ms"]
        table.add_row(method, _range(each["segments"]), *(_range(each["p_at_1"][tool]) for tool in KINDS),
                      "-" if spent is None else f"{spent:.1f}")
    return table


def _within(each: Figures) -> str:
    sigma = each["sigma_z"]
    if sigma is None or sigma["median_mm"] is None:
        return "-"
    return f"{sigma['within_1']['share']:.0%} {sigma['within_2']['share']:.0%} (σ {sigma['median_mm']:.2f} mm)"


def _off_by(each: Figures) -> str:
    off = each["off_mm"]
    return "-" if off["median"] is None else f"{off['median']:.2f} ({off['worst']:.1f}) mm"


def _range(share: Figures) -> str:
    low, high = share["interval"]
    return f"{_of(share)} ({low:.2f}-{high:.2f})"


def percent(share: Figures) -> str:
    """A share with its interval, for people."""
    low, high = share["interval"]
    return "-" if share["share"] is None else f"{share['share']:.1%} ({low:.1%} to {high:.1%})"


def _of(share: Figures) -> str:
    return f"{share['good']}/{share['of']}"
