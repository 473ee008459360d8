"""binpick: bin-picking perception for two GigE cameras on a CPU."""

from importlib.metadata import version

__version__ = version("binpick")
