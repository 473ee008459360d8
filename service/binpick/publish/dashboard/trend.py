"""The calibration's panel: the row errors of the last cycles between their limits, and what the reference marks say."""

from html import escape

from binpick.message import CalibrationMessage
from binpick.publish.dashboard.words import Tone
from binpick.result import Drift, Snapshot

TONES: dict[str, Tone] = {"ok": "good", "warn": "warn", "fault": "bad"}
WORDS = {"ok": "holds", "warn": "has drifted", "fault": "cannot be trusted"}
WIDE, HIGH = 240.0, 44.0
"""Of the curve, in the units of its own picture."""


def panel(snapshot: Snapshot) -> str:
    """Nothing where nobody watches."""
    known = snapshot.drift
    if known is None:
        return ""
    seen = known.latest
    state = "not looked at yet" if seen is None else WORDS[seen.level]
    figures = " · ".join([_rows(seen), _marks(known)])
    return (f'<div><div class="camera {TONES[known.level] if seen is not None else "off"}"><b>Calibration {state}</b>'
            f"{_curve(known)}<small>{escape(figures)}</small></div></div>")


def _rows(seen: CalibrationMessage | None) -> str:
    """Never without a sign: the curve above has one."""
    if seen is None or seen.row_px is None:
        return "rows not measured"
    corrected = ", corrected" if seen.correction is not None else ""
    return f"rows {seen.row_px:+.2f} px{corrected}".replace("-", "−")


def _marks(known: Drift) -> str:
    seen = known.latest.marks if known.latest is not None else None
    if known.marks != "stored":
        return {"none": "no reference marks", "to be stored": "reference marks not stored"}[known.marks]
    if seen is None or seen.shift_m is None:
        return "reference marks not seen"
    return f"{seen.seen} marks, moved {1000 * seen.shift_m:.2f} mm"


def _curve(known: Drift) -> str:
    """Newest at the right; the height is at least that of the fault limit both ways."""
    if not known.row_px:
        return ""
    most = max(known.fault_px, *(abs(row) for row in known.row_px)) * 1.1
    steps = max(len(known.row_px) - 1, 1)

    def level(px: float) -> float:
        return HIGH / 2 * (1 + px / most)     # rows count downwards, as the picture does

    lines = "".join(f'<line class="{name}" x1="0" x2="{WIDE:g}" y1="{level(px):.1f}" y2="{level(px):.1f}"></line>'
                    for name, limit in (("warn", known.warn_px), ("bad", known.fault_px)) for px in (-limit, limit))
    start = WIDE * (1 - steps / max(steps, 30))
    points = " ".join(f"{start + (WIDE - start) * i / steps:.1f},{level(row):.1f}" for i, row in enumerate(known.row_px))
    newest = points.rsplit(" ", 1)[-1].split(",")
    dot = WIDE if len(known.row_px) > 1 else float(newest[0])
    return (f'<svg class="curve" viewBox="0 0 {WIDE:g} {HIGH:g}" preserveAspectRatio="none">{lines}'
            f'<polyline points="{points}"></polyline>'
            f'<circle cx="{min(dot, WIDE - 3):.1f}" cy="{newest[1]}" r="2.5"></circle></svg>')
