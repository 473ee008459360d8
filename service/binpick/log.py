"""What the daemon tells the system's log: one line per event on stderr, UTC; a traceback only for defects of ours."""

import logging
import time

QUIET = ("asyncio", "httpx", "nicegui", "pymodbus", "uvicorn", "watchfiles")
"""Libraries that report every request or connection: from them only warnings."""


def configure() -> None:
    """Sets logging up for a daemon; called once, by the command that runs one."""
    handler = logging.StreamHandler()
    formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s", "%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    for name in QUIET:
        logging.getLogger(name).setLevel(logging.WARNING)
