"""Time the filter's QPs with ProxQP, as the filter calls it, and with DAQP; count where their answers differ.

The two solvers can disagree on whether a QP has a solution, or on the input by more than a thousandth of its range.
"""

from __future__ import annotations

from functools import partial
from unittest.mock import patch

import daqp
import numpy as np

from benchmarks import situations
from benchmarks.decide import SCANS
from benchmarks.timing import Figures, timed_each
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter import plan_search
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.qp_solver import ACCURACY, SOLVED, QuadraticProgram, Solution, solve
from brakeline.sim.sim_conditions import Conditions

APART = 1e-3  # of an input's range
SITUATIONS: tuple[tuple[str, str, str, Conditions | None], ...] = (
    ("residual", "ground", "residual", None),
    ("matrix zonotope", "ground", "matrix-zonotope", None),
    ("ground by scan", "ground", "residual", SCANS),
    ("quadrotor", "quadrotor", "residual", None),
    ("quadrotor by scan", "quadrotor", "residual", SCANS),
)


def programs(certificate: str, robot: RobotWithTask, conditions: Conditions | None) -> list[QuadraticProgram]:
    """Return the QPs that the filter solves for the recorded requests."""
    seen: list[QuadraticProgram] = []

    def note(program: QuadraticProgram) -> Solution:
        seen.append(program)
        return solve(program)

    safety_filter = Filter(situations.model(certificate, robot=robot))
    with patch.object(plan_search, "solve", note):
        for request in situations.requests(safety_filter, situations.messages(robot=robot, conditions=conditions)):
            safety_filter.decide(request)
    return seen


def by_daqp(program: QuadraticProgram) -> np.ndarray | None:
    """Return the solution of DAQP; None if it finds none."""
    n = len(program.h)
    low = np.full(len(program.b), -1e30)
    sense = np.zeros(len(program.b), dtype=np.int32)
    x, _, flag, _ = daqp.solve(np.diag(program.h), program.g.copy(), program.A.copy(), program.b.copy(), low, sense)
    return np.asarray(x[:n]) if flag >= 1 else None


def disagreements(seen: list[QuadraticProgram], inputs: int) -> dict[str, float]:
    """Return how often the solvers disagree, and the largest difference of the first `inputs` unknowns."""
    apart, other = [0.0], 0
    for program in seen:
        ours, theirs = solve(program), by_daqp(program)
        met = ours.status == SOLVED and ours.residual <= 2.0 * ACCURACY
        other += met != (theirs is not None)
        if met and theirs is not None:
            apart.append(float(np.abs(ours.x - theirs)[:inputs].max()))
    return {"disagree": other, "apart": sum(value > APART for value in apart), "most apart": max(apart)}


def run() -> Figures:
    """Return a row for each situation and solver."""
    figures: Figures = {}
    for name, kind, certificate, conditions in SITUATIONS:
        robot = robot_with_task(kind)
        seen = programs(certificate, robot, conditions)
        count, size = {"count": float(len(seen))}, f"{name} ({len(seen[0].h)} variables)"
        beside = disagreements(seen, robot.action_dim)
        figures[f"{size}: ProxQP"] = timed_each([partial(solve, program) for program in seen]) | count | beside
        figures[f"{size}: DAQP"] = timed_each([partial(by_daqp, program) for program in seen]) | count
    return figures
