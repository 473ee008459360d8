"""Threads for work on arrays: as many as OpenCV may use, for functions that do not hold Python's lock."""

from concurrent.futures import ThreadPoolExecutor

import cv2


def pool(name: str) -> ThreadPoolExecutor:
    """A pool for one stage's work; debuggers and `top -H` show its threads by this name."""
    return ThreadPoolExecutor(max(1, cv2.getNumThreads()), thread_name_prefix=f"binpick-{name}")
