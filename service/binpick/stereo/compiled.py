"""Functions that become machine code when they are first called, and are kept on disk for the next process."""

import inspect
import logging
from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])

log = logging.getLogger(__name__)


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
