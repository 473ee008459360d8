"""One cycle at a time: the state machine, its worker, and what is published."""

from binpick.cell.control import Cell

__all__ = ["Cell"]
