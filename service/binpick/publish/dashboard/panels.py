"""The page's panels as HTML, pure from a snapshot; whatever did not come from here is escaped."""

from html import escape

from binpick.data import CameraStatus
from binpick.publish.dashboard import words
from binpick.publish.dashboard.words import Banner
from binpick.result import GraspMessage, Published, Snapshot

ROWS = 6
"""Grasps shown; more is for programs."""
SUMS = ("total", "compute")
"""Times that are sums of others."""
COUNTS = {"finished": "cycles", "refused": "refused", "aborted": "aborted", "timeouts": "timed out", "late": "late",
          "camera_failures": "camera faults", "expired": "expired", "gate_stopped": "stopped at gate",
          "internal_errors": "errors"}


def banner(shown: Banner, snapshot: Snapshot) -> str:
    """The state across the top."""
    simulated = '<span class="chip">SIMULATED</span>' if snapshot.simulated else ""
    return (f'<header class="{shown.tone}"><b>{escape(shown.word)}</b><p>{escape(shown.reason)}</p>'
            f'<aside>{simulated}<span class="chip">control: {words.OWNERS[snapshot.owner]}</span></aside></header>')


def caption(pictured: Published | None, now_ns: int) -> str:
    """What the pictures show, and how old it is."""
    if pictured is None:
        return '<p class="none">The first cycle\'s picture will be here.</p>'
    return f"<p>cycle {pictured.result.cycle_id}, {words.age((now_ns - pictured.triggered_ns) / 1e9)}</p>"


def result(snapshot: Snapshot) -> str:
    """The last answer in its own words."""
    if snapshot.latest is None:
        return '<div class="card answer off"><b>&ndash;</b><div><p>No cycle has run yet.</p></div></div>'
    answer = snapshot.latest.result
    code = answer.return_code
    facts = [f"cycle {answer.cycle_id}", words.hold(snapshot)]
    if answer.bin is not None and answer.bin.fill_level is not None:
        facts.insert(1, f"bin {answer.bin.fill_level:.0%} full")
    return (f'<div class="card answer {words.tone(code)}"><b>{code.value}</b><div><p>{escape(code.message)}</p>'
            f'<small>{escape(" · ".join(facts))}</small></div></div>')


def grasps(snapshot: Snapshot) -> str:
    """The last grasps: where, how good, how sure."""
    if snapshot.latest is None:
        return _card("Grasps", _nothing())
    found = snapshot.latest.result.grasps
    if not found:
        return _card("Grasps", '<p class="none">None in the last cycle.</p>')
    rows = "".join(_grasp(grasp) for grasp in found[:ROWS])
    rest = f'<small class="more">and {len(found) - ROWS} more</small>' if len(found) > ROWS else ""
    return _card(f"Grasps, mm in frame {found[0].frame}",
                 "<table><thead><tr><th>#</th><th>x</th><th>y</th><th>z</th><th>quality</th><th>σ xy</th><th>σ z</th>"
                 f"<th>tool</th></tr></thead><tbody>{rows}</tbody></table>{rest}")


def _grasp(grasp: GraspMessage) -> str:
    x, y, z = (f"{1000 * value:.1f}".replace("-", "−") for value in grasp.position_m)
    return (f'<tr><td class="rank">{grasp.rank}</td><td>{x}</td><td>{y}</td><td>{z}</td>'
            f'<td class="quality">{_bar(grasp.quality, "good")}<span>{grasp.quality:.2f}</span></td>'
            f"<td>{1000 * grasp.sigma.xy_m:.2f}</td><td>{1000 * grasp.sigma.z_m:.2f}</td>"
            f"<td class=name>{escape(grasp.tool.name)}</td></tr>")


def funnel(snapshot: Snapshot) -> str:
    """Why there are no more grasps: what each stage left and took."""
    funneled = snapshot.latest.result.funnel if snapshot.latest else None
    title = "Why this many grasps" if snapshot.latest and snapshot.latest.result.grasps else "Why no grasp"
    if funneled is None or not funneled.counts:
        return _card(title, '<p class="none">The last cycle did not come so far.</p>' if snapshot.latest else _nothing())
    most = max(funneled.counts.values(), default=0) or 1
    lines = "".join(
        f'<li class="{"loss" if words.is_loss(name) else "kept"}{" top" if name == funneled.dominating else ""}">'
        f"<span>{escape(words.stage(name))}</span>{_bar(count / most, 'off' if words.is_loss(name) else 'good')}"
        f"<em>{'&minus;' if words.is_loss(name) and count else ''}{count}</em></li>"
        for name, count in funneled.counts.items() if count or not words.is_loss(name))
    return _card(title, f"<ul>{lines}</ul>")


def timings(snapshot: Snapshot) -> str:
    """Where the time went."""
    spent = snapshot.latest.result.timing_ms if snapshot.latest else {}
    total = spent.get("total") or spent.get("compute")
    stages = {name: ms for name, ms in spent.items() if name not in SUMS}
    longest = max(stages.values(), default=0.0) or 1.0
    lines = "".join(f"<li><span>{escape(name)}</span>{_bar(ms / longest, 'busy')}<em>{ms:.0f}</em></li>"
                    for name, ms in stages.items())
    return _card("Times, ms" + (f"<i>{total:.0f} in all</i>" if total else ""), f"<ul>{lines}</ul>" if lines else _nothing())


def cameras(snapshot: Snapshot) -> str:
    """Each camera, and what is wrong with it."""
    return f"<div>{''.join(_camera(status) for status in snapshot.cameras)}</div>"


def _camera(status: CameraStatus) -> str:
    tone = "good" if status.connected and not status.error else "bad"
    device = " ".join(part for part in (status.model, status.serial, status.address) if part)
    lost = f"{status.frames} frames · {status.resends} resends · {status.failures} failures"
    if status.ptp:
        lost += f" · PTP {escape(status.ptp)} {status.ptp_offset_us:+.1f} µs"
    wrong = f'<p class="wrong">{escape(status.error)}</p>' if status.error else ""
    return (f'<div class="camera {tone}"><b>{escape(status.name)}</b><small>{escape(device)}</small><small>{lost}</small>'
            f"{wrong}</div>")


def counts(snapshot: Snapshot) -> str:
    """The foot of the page: what happened since the start."""
    known = dict(snapshot.counts)
    tiles = [(f"{known.get(name, 0)}", label) for name, label in COUNTS.items()]
    sync = snapshot.latest.result.sync if snapshot.latest else None
    if sync is not None:
        tiles.append((f"{sync.skew_us:.0f} µs", f"skew, {sync.proof}"))
    return "<footer>" + "".join(f'<div class="tile"><b>{escape(value)}</b><small>{escape(label)}</small></div>'
                                for value, label in tiles) + "</footer>"


def _card(title: str, content: str) -> str:
    return f'<div class="card"><h2>{title}</h2>{content}</div>'


def _nothing() -> str:
    return '<p class="none">No cycle has run yet.</p>'


def _bar(share: float, tone: str) -> str:
    return f'<span class="bar"><i class="{tone}" style="width:{100 * min(max(share, 0.0), 1.0):.1f}%"></i></span>'
