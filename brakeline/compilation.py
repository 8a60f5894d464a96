"""Compilation of loops that NumPy cannot express, with Numba.

Numba compiles them at the first import of their module on a machine, and caches the result. Import such a module where
it is needed, not at the top of a file: Numba takes 0.1 s to load.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])
log = logging.getLogger(__name__)


def compiled(signature: str | None = None) -> Callable[[F], F]:
    """Return a decorator that compiles a function for a signature in Numba's notation.

    `f8[::1]` is a contiguous array of float64. Arguments of other types raise TypeError. Without a signature, which has
    no words for records, the first call compiles the function for its arguments. Division by zero gives inf or NaN, as
    in NumPy. The compiled code does not check indices, unless NUMBA_BOUNDSCHECK=1 is set.
    """

    def decorate(function: F) -> F:
        try:
            return cast(F, njit(signature, cache=True, error_model="numpy")(function))
        except RuntimeError:  # no folder for the cache
            _say_that_nothing_is_stored()
            return cast(F, njit(signature, error_model="numpy")(function))

    return decorate


@cache
def _say_that_nothing_is_stored() -> None:
    """Log, once in a process, that the compiled code cannot be stored."""
    log.warning(
        "Numba can store compiled code neither beside %s nor in your cache folder, so each process compiles for half a "
        "minute: set NUMBA_CACHE_DIR to a folder in which you may write",
        __file__,
    )
