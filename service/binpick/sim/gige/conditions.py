"""What besets one head: its cable, its network, and the faults of its firmware; frozen, and replaced as a whole."""

from dataclasses import dataclass, field, replace

from binpick.sim.gige.transit import Transit

LINK_MBPS = 2000.0
"""Twice a GigE camera's wire: fast, and a receiver with 4 MB of socket buffer keeps up."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Without arguments: none. `skew_us` is how much later than triggered it exposes; `pixel_format` is what it sends whatever
    it was told; packets larger than `mtu` (bytes with all headers) are lost; `answers` and `sends` fall when it hangs. Without
    its network cable (`plugged`) it keeps power and settings, and feels its lines, unless that wire (`wired`) is broken."""

    transit: Transit = field(default_factory=Transit)
    seed: int = 0
    link_mbps: float = LINK_MBPS
    mtu: int = 16_000
    plugged: bool = True
    wired: bool = True
    skew_us: float = 0.0
    answers: bool = True
    sends: bool = True
    early_leader: bool = False
    pixel_format: str = ""

    @property
    def reachable(self) -> bool:
        """Whether the network finds it."""
        return self.plugged and self.answers

    @property
    def streams(self) -> bool:
        """Whether its images leave."""
        return self.reachable and self.sends

    def rebooted(self) -> "Conditions":
        """Without those that a power cycle ends."""
        return replace(self, answers=True, sends=True, early_leader=False, pixel_format="")
