"""A stated bound in words: the share of verified plans that leave their tubes, at most, at 99 % confidence."""

from __future__ import annotations

import math

CONFIDENCE = 0.99
UNSTATED = 1.0  # what a statement that is missing or can't be read counts as
DIGITS = 2  # of a bound that is shown


def valid_bound(bound: float) -> float:
    """A bound that came from outside: `UNSTATED` if it is no share. NaN is none."""
    return bound if 0.0 <= bound <= 1.0 else UNSTATED


def rounded_up(bound: float) -> float:
    """To two digits: what is shown, and what is accepted, is never below what is stated."""
    if bound <= 0.0:
        return 0.0
    scale = 10.0 ** (DIGITS - 1 - math.floor(math.log10(bound)))
    return min(max(math.ceil(bound * scale) / scale, bound), 1.0)


def percent(bound: float) -> str:
    return f"{100.0 * rounded_up(bound):g} %"


def describe_verification(verified: bool, bound: float | None) -> str:
    """What a decision's `verified` is worth, e.g. "verified; at most 1.1 % of such plans leave their tube, at 99 %
    confidence". bound: None where none was recorded."""
    if not verified:
        return "not verified"
    if bound is None:
        return "verified; no bound was recorded"
    if valid_bound(bound) == UNSTATED:
        return "verified by a model set that states no bound"
    return f"verified; at most {percent(bound)} of such plans leave their tube, at {100.0 * CONFIDENCE:g} % confidence"
