"""The tests' own clock: it stands still while a process that only wants to sleep is kept from waking, and runs otherwise."""

import signal
import time
from collections.abc import Callable

import psutil


def test_the_clock_stands_while_the_machine_does(clock: Callable[[], float]) -> None:
    [sleeper] = [child for child in psutil.Process().children() if "sleeper.py" in " ".join(child.cmdline())]
    start, real = clock(), time.monotonic()
    sleeper.send_signal(signal.SIGSTOP)
    time.sleep(0.3)
    stood = clock() - start
    sleeper.send_signal(signal.SIGCONT)
    assert time.monotonic() - real > 0.3
    assert stood < 0.05
    time.sleep(0.05)
    assert stood <= clock() - start < time.monotonic() - real - 0.25


def test_work_of_ours_does_not_stop_it(clock: Callable[[], float]) -> None:
    sum(range(10**6))                   # the interpreter is busy with it
    start, real = clock(), time.thread_time()
    while time.thread_time() - real < 0.1:
        sum(range(10**6))
    assert clock() - start > 0.02
