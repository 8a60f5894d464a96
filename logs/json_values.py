"""Prepare numbers for JSON, which has no NaN and no infinity."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any


def finite(value: Any, digits: int | None = None) -> Any:
    """Replace each number in nested values that is not finite by None; with `digits`, round the others."""
    if isinstance(value, dict):
        return {key: finite(inner, digits) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner, digits) for inner in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def rounded(values: Iterable[float], digits: int = 4) -> list[float]:
    """Round to so many digits after the decimal point; a value that is not finite becomes 0."""
    return [round(float(value), digits) if math.isfinite(value) else 0.0 for value in values]
