"""Compare dataclasses that hold arrays: the `==` of a dataclass compares tuples, which raises for arrays."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def same_values(one: Any, other: object) -> bool:
    """Return whether two dataclasses are of one type and have equal values; NaN equals NaN.

    Fields with `compare=False`, such as measured times, do not count.
    """
    names = [item.name for item in fields(one) if item.compare]
    return type(one) is type(other) and all(_same(getattr(one, name), getattr(other, name)) for name in names)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return bool(np.all(one == other)) or (one != one and other != other)


class ComparedByValue:
    """The base of a dataclass with `eq=False` that holds arrays: `==` compares its values."""

    def __eq__(self, other: object) -> bool:
        return same_values(self, other)

    __hash__: Any = None  # as of every dataclass that is compared and holds arrays
