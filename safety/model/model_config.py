"""The settings from which a model set is fitted, and their possible values.

Every command that starts a run imports this module, so it imports nothing that loads slowly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

RESIDUAL, SET_MEMBERSHIP, MATRIX_ZONOTOPE = "residual", "set-membership", "matrix-zonotope"
KINDS = (RESIDUAL, SET_MEMBERSHIP, MATRIX_ZONOTOPE)  # of error bounds
ONE_STEP, DIRECT, RECURSION = "one-step", "direct", "recursion"
MODES = (DIRECT, RECURSION)  # of predictors that are linear in the inputs
AUTO = "auto"  # the mode of the model set that was last put to use
PLAN, FREE = "plan", "free"
WINDOWS = (PLAN, FREE)
DDPC, SECAS, SAILR, CBF, PSF = "ddpc", "secas", "sailr", "cbf", "psf"
METHODS = (DDPC, SECAS, SAILR, CBF, PSF)  # of a safety service
MOST_OUTSIDE = 0.1  # share of the windows: sets that more of them may leave are of no use


@dataclass(frozen=True)
class ModelConfig:
    """The settings with which a model set is fitted to a data set (docs/method.md §1).

    >>> ModelConfig(mode="one-step", windows="free").of_minutes().inflation
    1.5
    """

    certificate: str = RESIDUAL
    mode: str = DIRECT
    inflation: float = 1.15  # factor on every envelope, since new data may exceed the recorded data
    seed: int = 0  # for the recursion's random heading offsets
    windows: str = PLAN  # PLAN, or FREE for recorded driving that follows no plan
    fewest: int = 200  # least number of windows of each length
    outside: float = 0.001  # share of the windows that may leave the sets of mode ONE_STEP, in every kind of driving

    def __post_init__(self) -> None:
        if self.certificate not in KINDS:
            raise ValueError(f"no certificate is called {self.certificate!r}; there are: {', '.join(KINDS)}")
        if self.mode not in (AUTO, ONE_STEP, *MODES):
            raise ValueError(f"no mode is called {self.mode!r}; there are: {', '.join((AUTO, ONE_STEP, *MODES))}")
        if self.windows not in WINDOWS:
            raise ValueError(f"no windows are called {self.windows!r}; there are: {', '.join(WINDOWS)}")
        if not 1.0 <= self.inflation < math.inf:
            raise ValueError(
                f"an error bound scaled by {self.inflation} bounds nothing: inflation is a number of 1 or more"
            )
        if not 0.0 < self.outside <= MOST_OUTSIDE:
            raise ValueError(f"a share of {self.outside:g} of windows outside is not between 0 and {MOST_OUTSIDE:g}")

    def of_minutes(self) -> ModelConfig:
        """Return these settings for minutes of driving instead of hours: fewer windows, envelopes scaled by 1.5."""
        return replace(self, inflation=1.5, fewest=60)


def check_reservations(method: str) -> None:
    """Check that a method reserves space, which robots that share a world need.

    Raises:
        ValueError: the method makes no reservations.
    """
    if method not in (DDPC, "none"):
        raise ValueError(
            f"{method} predicts no tube, so it reserves no space for a robot: a fleet's method is {DDPC} or none"
        )
