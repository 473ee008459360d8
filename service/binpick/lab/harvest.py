"""The figures of emptied bins: what was taken of what could be, misses and collisions, how it ended, parts per hour."""

import itertools
from collections import Counter
from collections.abc import Sequence

from rich.table import Table

from binpick.errors import Code
from binpick.lab.clearing import TASKS, Clearing
from binpick.lab.tally import Figures, percent, share

HOUR_MS = 3.6e6


def figures(bins: Sequence[Clearing]) -> dict[str, Figures]:
    """A row per task, by its name, and all of them pooled."""
    tasks = {task.name: [one for one in bins if (one.kinds, one.tools) == (task.kinds, task.tools)] for task in TASKS}
    return {name: row(some) for name, some in {**tasks, "all": list(itertools.chain(*tasks.values()))}.items()}


def row(bins: Sequence[Clearing]) -> Figures:
    """Some bins pooled. A part that left was pickable; one that stayed is when the oracle finds it a grasp."""
    cycles = [cycle for one in bins for cycle in one.cycles]
    taken = [cycle.taken for cycle in cycles if cycle.taken is not None]
    removed, stayed = sum(one.removed for one in bins), [part for one in bins for part in one.left]
    spent_ms = sum(cycle.compute_ms for cycle in cycles)
    return {
        "bins": len(bins), "parts": sum(one.parts for one in bins), "cycles": len(cycles),
        "removed": share(removed, removed + sum(part.pickable for part in stayed)),
        "stayed": dict(sorted(Counter(part.kind for part in stayed if part.pickable).items())),
        "held": share(sum(not grasp.reason for grasp in taken), len(taken)),
        "lifted": share(sum(grasp.lifted for grasp in taken), sum(not grasp.reason for grasp in taken)),
        "misses": dict(Counter(grasp.reason for grasp in taken if grasp.reason).most_common()),
        "collisions": sum(grasp.collides for grasp in taken),
        "penetration_max_mm": round(1000 * max((grasp.penetration_m for grasp in taken), default=0.0), 2),
        "codes": {str(code): times for code, times in sorted(Counter(one.cycles[-1].code for one in bins).items())},
        "empty_with_part_in_view": sum(_overlooks(one) for one in bins),
        "parts_per_hour": round(removed / spent_ms * HOUR_MS) if spent_ms else None,
    }


def _overlooks(one: Clearing) -> bool:
    """Whether a bin was called empty in which the camera shows a part."""
    return one.cycles[-1].code == Code.BIN_EMPTY and any(part.pixels for part in one.left)


def table(rows: dict[str, Figures]) -> Table:
    """The same for people."""
    shown = Table("emptied by", "bins", "pickable taken", "share (95 %)", "cycles", "held", "lifted", "misses",
                  "collisions (worst)", "last codes", "102, part in view", "parts/h", title="Bins emptied in a closed loop",
                  title_justify="left")
    for name, each in rows.items():
        if each["bins"]:
            misses, removed, held, lifted = (each[name] for name in ("misses", "removed", "held", "lifted"))
            shown.add_row(name, str(each["bins"]), f"{removed['good']}/{removed['of']}", percent(removed), str(each["cycles"]),
                          f"{held['good']}/{held['of']}", f"{lifted['good']}/{lifted['of']}",
                          ", ".join(f"{times} {reason}" for reason, times in misses.items()) or "-",
                          f"{each['collisions']} ({each['penetration_max_mm']:.1f} mm)",
                          " ".join(f"{code}: {times}" for code, times in each["codes"].items()),
                          str(each["empty_with_part_in_view"]), str(each["parts_per_hour"]))
    return shown
