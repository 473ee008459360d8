"""Action commands: one datagram that triggers every head whose keys it fits, at once or at a time (GigE Vision 2.0)."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from binpick.sim.gige.gvcp import Command, Fault, Status

SCHEDULED = 0x80
"""The flag that announces a time behind the keys."""
SIGNALS = 2
"""Action0 and Action1."""


@dataclass(frozen=True, slots=True)
class Action:
    """`at_ns` is in the time that the heads share by PTP; None: at once."""

    device_key: int
    group_key: int
    group_mask: int
    at_ns: int | None = None

    def signals(self, device_key: int, groups: Sequence[tuple[int, int]]) -> tuple[int, ...]:
        """The head's signals, each with its own group key and mask, that the command means; most often none or one."""
        if self.device_key != device_key:
            return ()
        return tuple(number for number, (key, mask) in enumerate(groups) if key == self.group_key and mask & self.group_mask)


def parse(command: Command) -> Action:
    """Raises Fault when the datagram has not the length that its flags announce."""
    layout = ">IIIQ" if command.flags & SCHEDULED else ">III"
    if len(command.payload) != struct.calcsize(layout):
        raise Fault(Status.INVALID_PARAMETER)
    return Action(*struct.unpack(layout, command.payload))
