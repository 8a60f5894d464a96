"""Loops that NumPy has no words for, compiled when their module is first imported on a machine, and kept (Numba).

Import such a module where it is needed, not at the top: Numba takes 0.1 s to load.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(signature: str) -> Callable[[F], F]:
    """For these types, in Numba's words (`f8[::1]`: a contiguous row of float64); others raise TypeError.

    Division by zero gives inf or NaN as NumPy's does; indices are not looked at.
    """

    def of(function: F) -> F:
        try:
            return cast(F, njit(signature, cache=True, error_model="numpy")(function))
        except RuntimeError:  # no folder to keep it in: each process compiles it
            return cast(F, njit(signature, error_model="numpy")(function))

    return of
