"""One cycle at a time: the state machine, its worker, and what is published."""

from binpick.cell.control import Cell
from binpick.cell.worker import Cameras

__all__ = ["Cameras", "Cell"]
