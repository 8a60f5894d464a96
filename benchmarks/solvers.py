"""The filter's QPs by ProxQP, as the filter calls it, and by DAQP: how long they take; of how many the two disagree
whether they can be met, or on the input, by more than a thousandth of its range, and by how much at the most."""

from __future__ import annotations

from functools import partial
from unittest.mock import patch

import daqp
import numpy as np

from benchmarks import situations
from benchmarks.decide import SCANS
from benchmarks.timing import Figures, each
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter import filter as filtering
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.qp_solver import ACCURACY, SOLVED, QuadraticProgram, Solution, solve
from brakeline.sim.sim_conditions import Conditions

APART = 1e-3  # of an input's range
QUESTIONS: tuple[tuple[str, str, str, Conditions | None], ...] = (
    ("residual", "ground", "residual", None),
    ("matrix zonotope", "ground", "matrix-zonotope", None),
    ("ground by scan", "ground", "residual", SCANS),
    ("quadrotor", "quadrotor", "residual", None),
    ("quadrotor by scan", "quadrotor", "residual", SCANS),
)


def programs(certificate: str, robot: RobotWithTask, conditions: Conditions | None) -> list[QuadraticProgram]:
    """The QPs that come up."""
    seen: list[QuadraticProgram] = []

    def note(program: QuadraticProgram) -> Solution:
        seen.append(program)
        return solve(program)

    ready = Filter(situations.model(certificate, robot=robot))
    with patch.object(filtering, "solve", note):
        for request in situations.requests(ready, situations.messages(robot=robot, conditions=conditions)):
            ready.decide(request)
    return seen


def by_daqp(program: QuadraticProgram) -> np.ndarray | None:
    """None: it can't be met."""
    n = len(program.h)
    low = np.full(len(program.b), -1e30)
    sense = np.zeros(len(program.b), dtype=np.int32)
    x, _, flag, _ = daqp.solve(np.diag(program.h), program.g.copy(), program.A.copy(), program.b.copy(), low, sense)
    return np.asarray(x[:n]) if flag >= 1 else None


def disagreements(seen: list[QuadraticProgram], inputs: int) -> dict[str, float]:
    """How often the two do, and by how much at the most they do on the first so many unknowns."""
    apart, other = [0.0], 0
    for program in seen:
        ours, theirs = solve(program), by_daqp(program)
        met = ours.status == SOLVED and ours.residual <= 2.0 * ACCURACY
        other += met != (theirs is not None)
        if met and theirs is not None:
            apart.append(float(np.abs(ours.x - theirs)[:inputs].max()))
    return {"disagree": other, "apart": sum(value > APART for value in apart), "most apart": max(apart)}


def run() -> Figures:
    figures: Figures = {}
    for name, kind, certificate, conditions in QUESTIONS:
        robot = robot_with_task(kind)
        seen = programs(certificate, robot, conditions)
        count = {"count": float(len(seen))}
        size = f"{name} ({len(seen[0].h)} variables)"
        beside = disagreements(seen, robot.action_dim)
        figures[f"{size}: ProxQP"] = each([partial(solve, program) for program in seen]) | count | beside
        figures[f"{size}: DAQP"] = each([partial(by_daqp, program) for program in seen]) | count
    return figures
