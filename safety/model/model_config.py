"""How a model set is made, and what there is to choose from. Nothing heavy here: whoever starts a run reads it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

RESIDUAL, SET_MEMBERSHIP, MATRIX_ZONOTOPE = "residual", "set-membership", "matrix-zonotope"
KINDS = (RESIDUAL, SET_MEMBERSHIP, MATRIX_ZONOTOPE)  # of certificates
DIRECT, RECURSION = "direct", "recursion"
MODES = (DIRECT, RECURSION)
PLAN, FREE = "plan", "free"
WINDOWS = (PLAN, FREE)
DDPC, SECAS, SAILR = "ddpc", "secas", "sailr"
METHODS = (DDPC, SECAS, SAILR)  # of a safety service


@dataclass(frozen=True)
class ModelConfig:
    """How a model set is made from a data set."""

    certificate: str = RESIDUAL
    mode: str = DIRECT
    inflation: float = 1.15  # of every envelope: what the next data may exceed the recorded ones by
    seed: int = 0  # of the recursion's heading offsets
    windows: str = PLAN  # FREE: from driving that follows no plan
    fewest: int = 200  # windows of a length, below which nothing useful is bounded

    def __post_init__(self) -> None:
        if self.certificate not in KINDS:
            raise ValueError(f"no certificate is called {self.certificate!r}; there are: {', '.join(KINDS)}")
        if self.mode not in MODES:
            raise ValueError(f"no mode is called {self.mode!r}; there are: {', '.join(MODES)}")
        if self.windows not in WINDOWS:
            raise ValueError(f"no windows are called {self.windows!r}; there are: {', '.join(WINDOWS)}")
        if not 1.0 <= self.inflation < math.inf:
            raise ValueError(f"an envelope scaled by {self.inflation} bounds nothing")

    def of_minutes(self) -> ModelConfig:
        """The same from minutes of driving instead of hours: fewer windows, and every envelope half as wide again."""
        return replace(self, inflation=1.5, fewest=60)


def check_reservations(method: str) -> None:
    """Raises ValueError: robots that share a world are promised nothing by this method."""
    if method not in (DDPC, "none"):
        raise ValueError(f"{method} predicts nothing, so it makes no promises: a fleet's method is {DDPC} or none")
