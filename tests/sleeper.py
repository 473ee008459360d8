"""Sleeps 5 ms at a time and sums how much too late it woke: whom the machine holds up, it holds up this process too.

A process of its own, so that no test can do that. `sleeper.py FD`: the memory that FD names holds two doubles, the seconds it
was held up for so far and the time from which on it is late again (CLOCK_MONOTONIC, one for all processes).
"""

import mmap
import os
import struct
import sys
import time

NAP_S = 0.005
GRACE_S = 0.005
"""A machine with time to spare is not later than that."""


def main() -> None:
    board = mmap.mmap(int(sys.argv[1]), 16)
    parent, held_s, woken = os.getppid(), 0.0, time.monotonic()
    while os.getppid() == parent:
        late_from = woken + NAP_S + GRACE_S
        board[:] = struct.pack("dd", held_s, late_from)
        time.sleep(NAP_S)
        woken = time.monotonic()
        held_s += max(0.0, woken - late_from)


if __name__ == "__main__":
    main()
