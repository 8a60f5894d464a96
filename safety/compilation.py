"""Compilation of loops that NumPy cannot express, with Numba.

Numba compiles them at the first import of their module on a machine, and caches the result. Import such a module where
it is needed, not at the top of a file: Numba takes 0.1 s to load.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(signature: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for a signature in Numba's notation.

    `f8[::1]` is a contiguous array of float64. Arguments of other types raise TypeError. Division by zero gives inf or
    NaN, as in NumPy. The compiled code does not check indices, unless NUMBA_BOUNDSCHECK=1 is set.
    """

    def decorate(function: F) -> F:
        try:
            return cast(F, njit(signature, cache=True, error_model="numpy")(function))
        except RuntimeError:  # no folder for the cache: each process compiles anew
            return cast(F, njit(signature, error_model="numpy")(function))

    return decorate
