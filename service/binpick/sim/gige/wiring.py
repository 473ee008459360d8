"""Wires from one head's output line to another's input, and the edges that travel along them."""

from dataclasses import dataclass
from typing import NamedTuple

DELAY_NS = 20_000
"""From the master's exposure to the slave's: output driver, opto-coupler or GPIO, and the sensor's own trigger latency."""
JITTER_NS = 500


class Edge(NamedTuple):
    """A level changes, by the host's clock."""

    at_ns: int
    rising: bool


@dataclass(frozen=True, slots=True)
class Wire:
    """From `output` of head `source` to `input` of head `target`; lines by number."""

    source: int
    output: int
    target: int
    input: int
    delay_ns: int = DELAY_NS
    jitter_ns: int = JITTER_NS

    def carry(self, edge: Edge) -> Edge:
        """The edge as it arrives: later by the delay, and by a jitter that depends on the instant alone."""
        scatter = edge.at_ns // 1000 * 2_654_435_761 % (2 * self.jitter_ns + 1) - self.jitter_ns
        return Edge(edge.at_ns + self.delay_ns + scatter, edge.rising)


def harness(heads: int) -> tuple[Wire, ...]:
    """The cable that a rig of this size has: the first head's GPIO 1 to every other's GPIO 0, and its opto output (which also
    strobes the projector) to every other's opto input."""
    return tuple(Wire(0, output, target, line) for target in range(1, heads) for output, line in ((1, 0), (2, 3)))


def pulse(start_ns: int, exposure_us: float, inverted: bool) -> tuple[Edge, Edge]:
    """What an output that shows ExposureActive does."""
    return Edge(start_ns, not inverted), Edge(start_ns + int(exposure_us * 1000), inverted)


def fires(edge: Edge, inverted: bool, activation: str) -> bool:
    """Whether an input line with that inverter and TriggerActivation takes the edge for a trigger."""
    seen = "RisingEdge" if edge.rising is not inverted else "FallingEdge"
    return activation in (seen, "AnyEdge")
