"""Two GigE Vision cameras on the loopback interface: what a client finds, controls, triggers and streams from, in Python."""

from binpick.sim.gige.pair import GigePair, ImageFn

__all__ = ["GigePair", "ImageFn"]
