"""A head's clock as a line over the host's clock: an offset, a drift, and the way back."""

import time
from dataclasses import dataclass

BILLION = 1_000_000_000


def host_ns() -> int:
    """The host's clock, which is the truth that everything simulated happens on; nanoseconds since 1970."""
    return time.clock_gettime_ns(time.CLOCK_REALTIME)


@dataclass(frozen=True, slots=True)
class Clock:
    """Shows `device_ns` at `host_ns` and gains `drift_ppb` nanoseconds per second."""

    host_ns: int
    device_ns: int
    drift_ppb: int = 0

    def at(self, host_ns: int) -> int:
        """What it shows then."""
        elapsed = host_ns - self.host_ns
        return self.device_ns + elapsed + elapsed * self.drift_ppb // BILLION

    def when(self, device_ns: int) -> int:
        """When it shows that, to a nanosecond, by the host's clock."""
        return self.host_ns + (device_ns - self.device_ns) * BILLION // (BILLION + self.drift_ppb)

    def shifted(self, by_ns: int) -> "Clock":
        """A clock that is ahead of this one."""
        return Clock(self.host_ns, self.device_ns + by_ns, self.drift_ppb)
