"""The filter's QPs by ProxQP, as the filter calls it, and by DAQP."""

from __future__ import annotations

from functools import partial
from unittest.mock import patch

import daqp
import numpy as np

from deploy.bench import situations
from deploy.bench.timing import Figures, each
from safety import filter as filtering
from safety.filter import Filter
from safety.solver import Program, Solution, solve


def programs(certificate: str) -> list[Program]:
    """The QPs that come up."""
    seen: list[Program] = []

    def note(program: Program) -> Solution:
        seen.append(program)
        return solve(program)

    ready = Filter(situations.model(certificate))
    with patch.object(filtering, "solve", note):
        for request in situations.requests(ready, situations.messages()):
            ready.decide(request)
    return seen


def by_daqp(program: Program) -> np.ndarray:
    n = len(program.h)
    low = np.full(len(program.b), -1e30)
    sense = np.zeros(len(program.b), dtype=np.int32)
    x, *_ = daqp.solve(np.diag(program.h), program.g.copy(), program.A.copy(), program.b.copy(), low, sense)
    return np.asarray(x[:n])


def run() -> Figures:
    figures: Figures = {}
    for certificate in ("residual", "matrix-zonotope"):
        seen = programs(certificate)
        size = f"{len(seen[0].h)} variables"
        figures[f"{certificate} ({size}): ProxQP"] = each([partial(solve, p) for p in seen]) | {"count": len(seen)}
        figures[f"{certificate} ({size}): DAQP"] = each([partial(by_daqp, p) for p in seen]) | {"count": len(seen)}
    return figures
