"""Functions that become machine code when they are first called, and are kept on disk for the next process."""

import hashlib
import inspect
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import caching

F = TypeVar("F", bound=Callable[..., object])

log = logging.getLogger(__name__)

SOURCES = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(Path(__file__).parent.glob("*.py")))).hexdigest()
"""Of all modules whose functions become part of each other's machine code."""


def _together(locator: Any) -> Any:
    """A place to keep machine code that is void once any of SOURCES changed; numba's own asks for the caller's file alone."""
    return type(locator.__name__, (locator,), {"get_source_stamp": lambda self: (SOURCES, locator.get_source_stamp(self))})


Named, Beside, Users = map(_together, (caching.UserProvidedCacheLocator, caching.InTreeCacheLocator,
                                       caching.UserWideCacheLocator))
"""NUMBA_CACHE_DIR, the sources' __pycache__, the user's own cache: the first that can be written."""
numba.config.CACHE_LOCATOR_CLASSES = ",".join(f"{__name__}.{place}" for place in ("Named", "Beside", "Users"))


def compiled(function: F) -> F:
    """The function as machine code that does not hold Python's lock; its arguments are arrays, numbers and tuples of them.

    Where nothing can be kept on disk (NUMBA_CACHE_DIR names a place), each process compiles anew: some seconds at its first
    cycle. Dividing by zero gives infinity or NaN, as in numpy. What checks types in the tests is taken off: it cannot be
    compiled.
    """
    plain = inspect.unwrap(function)
    try:
        code: F = numba.njit(plain, nogil=True, cache=True, error_model="numpy")
    except RuntimeError as error:
        log.warning("compiled loops cannot be kept, starting takes longer: %s", error)
        code = numba.njit(plain, nogil=True, error_model="numpy")
    return code
