"""Charts: bars of views, points of tilt and distance, and the curve of depth errors, as SVG."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from binpick_calib.outlook import Outlook

WIDTH, HEIGHT = 640, 300
LEFT, BOTTOM, TOP, RIGHT = 56, 44, 14, 14
"""Margins for the axes' words."""


def bars(values: dict[str, tuple[float, ...]], names: Sequence[str], unit: str) -> str:
    """Groups of bars, one for each camera; NaN has none. A line at the median."""
    top = 1.15 * float(np.nanmax(list(values.values())))
    group = (WIDTH - LEFT - RIGHT) / len(values)
    bar = min(0.8 * group / len(names), 26.0)
    drawn = ""
    for place, (label, each) in enumerate(values.items()):
        middle = LEFT + (place + 0.5) * group
        for camera, value in enumerate(each):
            if np.isfinite(value):
                high = (HEIGHT - TOP - BOTTOM) * value / top
                drawn += (f'<rect class="camera{camera}" x="{middle + (camera - len(each) / 2) * bar:.1f}" '
                          f'y="{HEIGHT - BOTTOM - high:.1f}" width="{bar - 1:.1f}" height="{high:.1f}"/>')
        drawn += f'<text class="tick mid" x="{middle:.1f}" y="{HEIGHT - BOTTOM + 16}">{label}</text>'
    usual = HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * float(np.nanmedian(list(values.values()))) / top
    line = f'<path class="rule" d="M{LEFT} {usual:.1f}H{WIDTH - RIGHT}"/>'
    keys = "".join(f'<rect class="camera{camera}" x="{LEFT + 110 * camera}" y="{HEIGHT - 13}" width="10" height="10"/>'
                   f'<text class="tick" x="{LEFT + 110 * camera + 15}" y="{HEIGHT - 4}">{name}</text>'
                   for camera, name in enumerate(names))
    return _chart(_rows(0.0, top, unit) + drawn + line + keys)


def points(across: Sequence[float], up: Sequence[float], words: tuple[str, str]) -> str:
    """Dots over two axes, both from 0 or the least."""
    low, high = 0.9 * min(across), 1.1 * max(across)
    top = max(1.1 * max(up), 10.0)
    dots = "".join(f'<circle class="camera0" r="5" cx="{_x(x, low, high):.1f}" cy="{_y(y, 0.0, top):.1f}"/>'
                   for x, y in zip(across, up, strict=True))
    return _chart(_rows(0.0, top, words[1]) + _columns(low, high, words[0]) + dots)


def depth(ahead: Outlook, shown_m: tuple[float, float]) -> str:
    """Millimetres of one sigma over metres of distance; shaded: where the board was."""
    far = ahead.distance_m
    low, high, top = float(far[0]), float(far[-1]), 1050 * float(np.nanmax([ahead.total_m, ahead.worst_m, ahead.matching_m]))
    band = _x(shown_m[0], low, high), _x(shown_m[1], low, high)
    shade = f'<rect class="band" x="{band[0]:.1f}" y="{TOP}" width="{band[1] - band[0]:.1f}" height="{HEIGHT - TOP - BOTTOM}"/>'
    curves = "".join(f'<path class="curve {name}" d="{_curve(far, 1000 * sigma, low, high, top)}"/>' for name, sigma in (
        ("worst", ahead.worst_m), ("middle", ahead.middle_m), ("matching", ahead.matching_m), ("total", ahead.total_m)))
    return _chart(shade + _rows(0.0, top, "mm") + _columns(low, high, "m") + curves)


def _curve(across: Float[np.ndarray, "n"], up: Float[np.ndarray, "n"], low: float, high: float, top: float) -> str:
    return "M" + "L".join(f"{_x(x, low, high):.1f} {_y(y, 0.0, top):.1f}"
                          for x, y in zip(across.tolist(), up.tolist(), strict=True) if np.isfinite(y))


def _x(value: float, low: float, high: float) -> float:
    return LEFT + (WIDTH - LEFT - RIGHT) * (value - low) / max(high - low, 1e-12)


def _y(value: float, low: float, high: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (value - low) / max(high - low, 1e-12)


def _ticks(low: float, high: float) -> list[float]:
    """About five round numbers."""
    rough = max(high - low, 1e-12) / 5
    power = 10 ** np.floor(np.log10(rough))
    step = power * next(m for m in (1, 2, 5, 10) if rough <= m * power * 1.0001)
    return [float(tick) for tick in np.arange(np.ceil(low / step) * step, high + 1e-9 * step, step)]


def _rows(low: float, high: float, unit: str) -> str:
    lines = "".join(f'<path class="grid" d="M{LEFT} {_y(tick, low, high):.1f}H{WIDTH - RIGHT}"/>'
                    f'<text class="tick end" x="{LEFT - 6}" y="{_y(tick, low, high) + 4:.1f}">{tick:g}</text>'
                    for tick in (round(t, 9) for t in _ticks(low, high)))
    return f'{lines}<text class="tick" x="2" y="{TOP + 2}">{unit}</text>'


def _columns(low: float, high: float, unit: str) -> str:
    lines = "".join(f'<text class="tick mid" x="{_x(tick, low, high):.1f}" y="{HEIGHT - BOTTOM + 16}">{tick:g}</text>'
                    for tick in (round(t, 9) for t in _ticks(low, high)))
    return f'{lines}<text class="tick end" x="{WIDTH - RIGHT}" y="{HEIGHT - 6}">{unit}</text>'


def _chart(content: str) -> str:
    return f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{content}</svg>'
