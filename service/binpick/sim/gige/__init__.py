"""GigE Vision cameras on the loopback interface: what a client finds, controls, triggers and streams from, in Python."""

from binpick.sim.gige.door import Door
from binpick.sim.gige.group import GigeGroup, ImageFn
from binpick.sim.gige.pair import GigePair

__all__ = ["Door", "GigeGroup", "GigePair", "ImageFn"]
