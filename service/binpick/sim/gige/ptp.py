"""PTP between the heads: who hears whom, who leads, how far each has come, and what its clock shows meanwhile.

States of IEEE 1588. The leader is the first head that can be; it keeps its own clock, so the followers' time is the leader's,
not the host's. A switch-over to another leader steps the followers' clocks.
"""

import threading
from dataclasses import dataclass, replace

from binpick.sim.gige.clock import Clock, host_ns

SETTLE_S = 0.4
"""From PtpEnable to Slave; half of it until a leader leads. Real cameras take 10 s and more."""
RESIDUAL_NS = 150
"""How far a follower stays off its leader, times its place in the group: switches that know PTP reach that."""


@dataclass(frozen=True, slots=True)
class Oscillator:
    """A head's own clock: ahead of the host's by `offset_ns` when it gets power, and drifting from there."""

    offset_ns: int = 0
    drift_ppb: int = 0


OSCILLATORS = (Oscillator(310_000_017, 23_000), Oscillator(-470_000_101, -17_000), Oscillator(901_000_003, 8_000),
               Oscillator(-20_000_500, -41_000), Oscillator(77_000_777, 30_500))
"""Of the first to the fifth head."""


@dataclass(frozen=True, slots=True)
class Port:
    """One head's part in it; times are the host's. `forced` is a state that a fault holds it in."""

    own: Clock
    since_ns: int | None = None
    forced: str = ""
    segment: int = 0
    residual_ns: int = 0
    leader: int | None = None
    cut: bool = False


class Ptp:
    """All heads' clocks. Any thread may ask; what is asked is brought up to date first."""

    def __init__(self, oscillators: tuple[Oscillator, ...], settle_s: float = SETTLE_S, apart: bool = False) -> None:
        """`apart`: each head is on a network of its own and hears nobody."""
        self._oscillators = oscillators
        self._settle_ns = int(settle_s * 1e9)
        self._apart = apart
        self._lock = threading.Lock()
        self._ports = [Port(Clock(0, 0), segment=index * apart, residual_ns=index * RESIDUAL_NS)
                       for index in range(len(oscillators))]
        for index in range(len(oscillators)):
            self.power(index, host_ns())

    def power(self, index: int, now_ns: int) -> None:
        """It gets power: PTP is off, and its clock runs as its oscillator does."""
        own = self._oscillators[index]
        self._change(index, now_ns, own=Clock(now_ns, now_ns + own.offset_ns, own.drift_ppb), since_ns=None, leader=None)

    def tune(self, index: int, oscillator: Oscillator, now_ns: int) -> None:
        """Another clock from now on, and after each power-up."""
        self._oscillators = (*self._oscillators[:index], oscillator, *self._oscillators[index + 1:])
        own = Clock(now_ns, now_ns + oscillator.offset_ns, oscillator.drift_ppb)
        self._change(index, now_ns, own=own)

    def enable(self, index: int, on: bool, now_ns: int) -> None:
        """Begins at Initializing, or ends; on an enabled one nothing."""
        with self._lock:
            running = self._ports[index].since_ns is not None
        if running != on:
            self._change(index, now_ns, since_ns=now_ns if on else None)

    def force(self, index: int, state: str, now_ns: int) -> None:
        """Holds it in a state such as Faulty or Listening, whatever it hears; "" lets it begin again."""
        with self._lock:
            since_ns = self._ports[index].since_ns
        self._change(index, now_ns, forced=state, since_ns=None if since_ns is None else now_ns)

    def move(self, index: int, segment: int, now_ns: int) -> None:
        """To another network; heads of one number hear each other."""
        self._change(index, now_ns, segment=segment)

    def cut(self, index: int, on: bool, now_ns: int) -> None:
        """Nothing goes in or out of it for a while; when it is heard again, it begins anew."""
        with self._lock:
            port = self._ports[index]
        if port.cut != on:
            self._change(index, now_ns, cut=on, since_ns=None if port.since_ns is None else now_ns)

    def stray(self, index: int, residual_ns: int, now_ns: int) -> None:
        """As a follower it is off by that much, and believes it is not."""
        self._change(index, now_ns, residual_ns=residual_ns)

    def mend(self, index: int, now_ns: int) -> None:
        """Ends what was forced, moved or strayed."""
        self.force(index, "", now_ns)
        self._change(index, now_ns, segment=index * self._apart, residual_ns=index * RESIDUAL_NS)

    def reset(self, index: int, now_ns: int) -> None:
        """Its clock begins again at 0, unless it follows."""
        with self._lock:
            self._update(now_ns)
            port = self._ports[index]
            if port.leader is None:
                self._ports[index] = replace(port, own=Clock(now_ns, 0, port.own.drift_ppb))

    def state(self, index: int, now_ns: int) -> str:
        """Disabled, Initializing, Listening, Master, Uncalibrated, Slave, or what a fault forces."""
        with self._lock:
            self._update(now_ns)
            return self._state(index, now_ns)

    def clock(self, index: int, now_ns: int) -> Clock:
        """What its clock shows around then."""
        with self._lock:
            self._update(now_ns)
            return self._clock(index)

    def leader(self, index: int, now_ns: int) -> int | None:
        """Whom it follows; itself when it leads; None when it does neither."""
        with self._lock:
            self._update(now_ns)
            return index if self._state(index, now_ns) == "Master" else self._ports[index].leader

    def offset_ns(self, index: int, now_ns: int) -> int:
        """How far a follower finds itself off its leader: the noise of its measurement, some tens of nanoseconds."""
        followed = self.state(index, now_ns) == "Slave"
        return (now_ns // 1_000_000 * 7919 + index * 31) % 81 - 40 if followed else 0

    def _change(self, index: int, now_ns: int, **changes: object) -> None:
        with self._lock:
            self._update(now_ns)
            self._ports[index] = replace(self._ports[index], **changes)   # type: ignore[arg-type]
            self._update(now_ns)

    def _update(self, now_ns: int) -> None:
        """Those that begin or cease to follow get the clock that this means."""
        for index, port in enumerate(self._ports):
            leader = self._master(index, now_ns) if self._state(index, now_ns) == "Slave" else None
            if leader == port.leader:
                continue
            own = port.own
            if port.leader is not None:
                own = Clock(now_ns, self._clock(index).at(now_ns), own.drift_ppb)     # runs on freely from where it is
            self._ports[index] = replace(port, own=own, leader=leader)

    def _clock(self, index: int) -> Clock:
        port = self._ports[index]
        return port.own if port.leader is None else self._ports[port.leader].own.shifted(port.residual_ns)

    def _master(self, listener: int, now_ns: int) -> int | None:
        """The first head that it hears, or is, and that has listened long enough."""
        own = self._ports[listener]
        for index, port in enumerate(self._ports):
            ripe = port.since_ns is not None and now_ns - port.since_ns >= self._settle_ns // 2
            heard = port.segment == own.segment and not port.cut and not own.cut
            if ripe and not port.forced and (heard or index == listener):
                return index
        return None

    def _state(self, index: int, now_ns: int) -> str:
        port = self._ports[index]
        if port.since_ns is None:
            return "Disabled"
        if port.forced:
            return port.forced
        elapsed = now_ns - port.since_ns
        if elapsed < self._settle_ns // 4:
            return "Initializing"
        if elapsed < self._settle_ns // 2:
            return "Listening"
        master = self._master(index, now_ns)
        if master == index:
            return "Master"
        led_ns = 0 if master is None else now_ns - (self._ports[master].since_ns or 0)
        return "Slave" if min(elapsed, led_ns) >= self._settle_ns else "Uncalibrated"
