"""Check the numbers of tasks and of conditions. A message names the key and the value."""

from __future__ import annotations

import math

Number = float | int
Numbers = Number | tuple[Number, ...] | None  # None: there is no value


def check_numbers(values: object, *names: str, least: float | None = None, above: float | None = None) -> None:
    """Check that numbers are finite and not too small.

    Args:
        values: has the numbers, or tuples of them, as attributes.
        names: of the attributes.
        least: the smallest allowed number.
        above: all numbers must be larger than this one.

    Raises:
        ValueError: a number is not allowed.
    """
    for name in names:
        value: Numbers = getattr(values, name)
        for number in _numbers(value):
            if not math.isfinite(number):
                raise ValueError(f"{name} = {_shown(value)} is not finite")
            if above is not None and number <= above:
                raise ValueError(f"{name} = {_shown(value)} is not above {above:g}")
            if least is not None and number < least:
                raise ValueError(f"{name} = {_shown(value)} is not {least:g} or more")


def check_most(values: object, *names: str, most: float) -> None:
    """Check that numbers are not above `most`. values, names: see `check_numbers`. Raises ValueError."""
    for name in names:
        value: Numbers = getattr(values, name)
        if any(number > most for number in _numbers(value)):
            raise ValueError(f"{name} = {_shown(value)} is not {most:g} or less")


def check_ranges(values: object, *names: str) -> None:
    """Check pairs (least, most) of finite numbers. values, names: see `check_numbers`.

    Raises:
        ValueError: a number is not finite, or below 0, or the largest one comes first.
    """
    check_numbers(values, *names, least=0.0)
    for name in names:
        low, high = getattr(values, name)
        if low > high:
            raise ValueError(f"{name} = {_shown((low, high))} has the largest number first: exchange them")


def check_sizes(values: object, **counts: tuple[int, int]) -> None:
    """Check the ranges of the sizes of obstacles [m]. If there can be obstacles of a size, it must be above 0.

    Args:
        values: has the ranges as attributes.
        counts: the name of each range, and the (least, most) number of its obstacles.

    Raises:
        ValueError: a size is not allowed.
    """
    for name, (_, most) in counts.items():
        check_ranges(values, name)
        if most > 0:
            check_numbers(values, name, above=0.0)


def _numbers(value: Numbers) -> tuple[Number, ...]:
    return value if isinstance(value, tuple) else () if value is None else (value,)


def _shown(value: Numbers) -> str:
    return str(list(value)) if isinstance(value, tuple) else str(value)
