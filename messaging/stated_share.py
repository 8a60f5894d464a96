"""The stated bound of a model set: the largest share of verified plans that leave their tubes, at 99 % confidence."""

from __future__ import annotations

import math

CONFIDENCE = 0.99
UNSTATED = 1.0  # value of a bound that is missing or invalid
DIGITS = 2  # significant digits of a displayed bound


def valid_bound(bound: float) -> float:
    """Return a bound from outside, or `UNSTATED` if it is no share (NaN included)."""
    return bound if 0.0 <= bound <= 1.0 else UNSTATED


def rounded_up(bound: float) -> float:
    """Round a bound up to two digits, so that the displayed bound is never below the stated one."""
    if bound <= 0.0:
        return 0.0
    scale = 10.0 ** min(DIGITS - 1 - math.floor(math.log10(bound)), 300)  # a larger one is beyond a float
    return min(max(math.ceil(bound * scale) / scale, bound), 1.0)


def percent(bound: float) -> str:
    """Return a bound, rounded up, in percent."""
    return f"{100.0 * rounded_up(bound):g} %"


def describe_verification(verified: bool, bound: float | None) -> str:
    """Describe whether a plan was verified, with the stated bound (None: none was recorded).

    Example: "verified; at most 1.1 % of such plans leave their tube, at 99 % confidence".
    """
    if not verified:
        return "not verified"
    if bound is None:
        return "verified; no bound was recorded"
    if valid_bound(bound) == UNSTATED:
        return "verified by a model set that states no bound"
    return f"verified; at most {percent(bound)} of such plans leave their tube, at {100.0 * CONFIDENCE:g} % confidence"
