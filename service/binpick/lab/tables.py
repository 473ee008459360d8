"""The stereo bench's figures as tables for people: methods, kinds of surface, calibration of sigma, real scenes."""

from typing import Any

from rich.console import Group
from rich.table import Table

from binpick.lab import methods

TITLES = {
    "mixed_A": "world A, mixed parts", "mixed_B": "world B, mixed parts", "metal_A": "world A, dark shiny steel",
    "metal_gray_A": "world A, dark shiny steel, ours by Gray code (43 shots)",
    "no_projector_A": "world A, mixed parts, projector off",
}
NAMES = {
    "plain_sgbm": "plain SGBM", "sgbm_wls": "SGBM + WLS", "sgbm_wls_confident": "SGBM, WLS confidence > 200", "bm": "BM",
    "ssd": "SSD windows", "ncc": "NCC windows", "quality": "ours: quality", "fast": "ours: fast",
}
Figures = dict[str, Any]


def tables(run: Figures) -> Group:
    """A run of `binpick bench stereo`."""
    head = (f"Exam tables {run['exam_sha256'][:12]}, {run['threads']} threads. On pixels of parts; × plain: time in calls of "
            "plain SGBM, ours from camera images to mask.")
    parts: list[Table | str] = [head]
    for name, series in run["series"].items():
        seeds = series["seeds"]
        parts.append(_rows(f"{TITLES[name]}, seeds {seeds[0]} to {seeds[-1]}", series))
        parts.append(_splits(series))
        parts.append(_calibration(series))
    if run["middlebury"]:
        parts.append(_middlebury(run["middlebury"]))
    return Group(*parts)


def _rows(title: str, series: Figures) -> Table:
    table = _table(title, "method", "density", "bad-0.5", "bad-1", "bad-2", "median |Δd|", "p95",
                   "bias on planes (worst)", "median |Δz|", "time", "× plain")
    for name, row in series["rows"].items():
        bias = "-" if row["plane_bias_px"] is None else f"{row['plane_bias_px']:+.3f} ({row['plane_bias_worst_px']:+.3f}) px"
        table.add_row(NAMES[name], _percent(row["density"]), *(_percent(row[k]) for k in ("bad05", "bad1", "bad2")),
                      _number(row["median_px"], "px"), _number(row["p95_px"], "px"), bias, _number(row["dz_median_mm"], "mm"),
                      f"{row['time_ms']:.0f} ms", f"{row['times_plain']:.2f}")
    return table


def _splits(series: Figures) -> Table:
    table = _table("", "by surface", "", "of part pixels", "density", "bad-0.5", "bad-1", "bad-2", "median |Δd|", "p95", "bias")
    for name, split in series["splits"].items():
        for place, row in split.items():
            table.add_row(NAMES[name], place, *(_percent(row[k]) for k in ("share_of_part_pixels", "density", "bad05", "bad1",
                                                                           "bad2")),
                          _number(row["median_px"], "px"), _number(row["p95_px"], "px"), _number(row["bias_px"], "px", "+"))
    return table


def _calibration(series: Figures) -> Table:
    seeds = [str(scene["seed"]) for scene in series["sigma"][methods.OURS[0]]]
    table = _table("", "σ per scene", "", *seeds)
    for name, scenes in series["sigma"].items():
        for key, title in (("within_1", "within 1σ, off edges"), ("within_2", "within 2σ, off edges"),
                           ("edges_within_1", "within 1σ, at edges")):
            table.add_row(NAMES[name], title, *(_percent(scene[key]) for scene in scenes))
    return table


def _middlebury(scenes: dict[str, Figures]) -> Table:
    table = _table("Middlebury, not occluded, five paths", "scene", "method", "density", "bad-1", "bad-2", "median |Δd|",
                   "bad-1 less by", "bad-2 less by")
    for name, scene in scenes.items():
        equal = scene["at_density_of"]
        rows = [("plain SGBM", scene["plain_sgbm_bare"], None), ("ours, as dense", equal["plain_sgbm_bare"], "plain_sgbm_bare"),
                ("plain SGBM, border repeated", scene[methods.PLAIN], None),
                ("ours, as dense", equal[methods.PLAIN], methods.PLAIN),
                ("ours: quality", scene["quality"], None)]
        for method, row, against in rows:
            less = scene["less"][against] if against else {"bad1": None, "bad2": None}
            table.add_row(name, method, *(_percent(row[k]) for k in ("density", "bad1", "bad2")),
                          _number(row["median_px"], "px"), *map(_percent, less.values()))
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title or None, title_justify="left", pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i else "left")
    return table


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _number(value: float | None, unit: str = "", sign: str = "") -> str:
    return "-" if value is None else f"{value:{sign}.3f} {unit}".rstrip()
