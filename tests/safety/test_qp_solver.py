"""The QP: another solver finds the same solutions, and the filter recomputes the residual itself."""

import json
from dataclasses import replace
from pathlib import Path

import daqp
import numpy as np
import pytest

from brakeline.messaging.obstacle import Shapes
from brakeline.safety.filter import qp_solver
from brakeline.safety.filter.halfspaces import half_spaces
from brakeline.safety.filter.kernels.active_set_kernels import hildreth_active_set
from brakeline.safety.filter.plan_inputs import PlanInputs
from brakeline.safety.filter.qp import ObstacleRows, QPBuilder
from brakeline.safety.filter.qp_solver import ACCURACY, QuadraticProgram, Solution, solve
from brakeline.safety.model.model_set import ModelSet
from tests.safety.asked import cylinder


def programs(model: ModelSet, count, seed=0):
    """QPs as the filter builds them, of proposals near obstacles."""
    rng = np.random.default_rng(seed)
    tube, outer = model.tube(), model.outer_tube()
    layout, builder = ObstacleRows(tube.directions), QPBuilder(PlanInputs(model.robot), outer)
    for _ in range(count):
        angles, distance = rng.uniform(-np.pi, np.pi, 4), rng.uniform(0.26, 0.36, 4)
        posts = [cylinder(r * np.cos(a), r * np.sin(a)) for a, r in zip(angles, distance, strict=True)]
        v, w = rng.uniform(0, 0.25), rng.uniform(-0.5, 0.5)
        z_0, r = np.array([v, w, v, w]), rng.uniform([0.0, -0.5], [0.25, 0.5])
        nominal = tube.centers(np.concatenate([z_0, r]))
        normals, offsets = half_spaces(Shapes.of(posts, 2), np.zeros(2), nominal, 0.105, np.full(2, 0.004))
        center = tube.position, tube.offset, tube.stretch
        program = builder.program(layout.rows(center, normals, offsets, 1.0), z_0, r)
        if program is not None:
            yield builder, program


def by_daqp(program):
    """Return DAQP's solution and its flag: 1 or more if it solved the program."""
    rows, below = np.ascontiguousarray(program.A), np.full(len(program.b), -1e30)
    kinds = np.zeros(len(program.b), dtype=np.int32)
    x, _, flag, _ = daqp.solve(np.diag(program.h), program.g, rows, program.b, below, kinds)
    return x[: len(program.h)], flag


def value(program, x):
    return 0.5 * x @ (program.h * x) + program.g @ x


def crowded(rng, rows=160, n=6):
    """Return a projection onto a body with many faces, some of them nearly equal. Sometimes the body is empty."""
    A = rng.normal(size=(rows, n))
    A[: rows // 2] = A[0] + 0.05 * A[: rows // 2]
    A = np.vstack([A / np.linalg.norm(A, axis=1, keepdims=True), np.eye(n), -np.eye(n)])
    b = A @ rng.uniform(-0.8, 0.8, n) + rng.uniform(-rng.uniform(0.0, 0.4), 0.8, len(A))
    b[-2 * n :] = 1.0
    return QuadraticProgram(
        np.array([1.0] * 3 + [1e-4] * 3), np.array([*rng.uniform(-2.0, 2.0, 3), 0, 0, 0]), A, b, 2 * n
    )


@pytest.fixture
def parts(monkeypatch):
    """The numbers of rows that the solver was called with, in order."""
    sizes = []
    monkeypatch.setattr(
        qp_solver,
        "_solved",
        lambda part, *more, of=qp_solver._solved, **how: sizes.append(len(part.b)) or of(part, *more, **how),
    )
    return sizes


def test_the_active_rows_alone_give_the_solution_of_all_rows(parts):
    impossible = 0
    for seed in range(100):
        program = crowded(np.random.default_rng(seed))
        ours, (theirs, flag) = solve(program), by_daqp(program)
        assert (ours.status == "solved") == (flag >= 1)
        impossible += flag < 1
        if flag >= 1:
            assert ours.residual <= ACCURACY and (program.A @ ours.x - program.b).max() <= ACCURACY
            assert np.abs(ours.x - theirs).max() < 1e-6
            assert value(program, ours.x) == pytest.approx(value(program, theirs), abs=1e-5)
        assert np.array_equal(solve(program).x, ours.x, equal_nan=True), "it is deterministic"
    assert 10 < impossible < 90 and np.mean(parts) < 30, "few of 172 rows, also where there is no solution"


def test_the_guessed_active_set_changes_no_solution(monkeypatch):
    feasible = [program for program in map(crowded, map(np.random.default_rng, range(300))) if by_daqp(program)[1] >= 1]
    guessed = [solve(program).x for program in feasible]
    monkeypatch.setattr(qp_solver, "STEPS", 0)
    assert np.abs(np.array(guessed) - [solve(program).x for program in feasible]).max() < 1e-9


def test_rows_that_occur_twice_change_no_solution(parts):
    """Their multipliers are not unique, and the solver by itself is off by up to its accuracy."""
    feasible = [program for program in map(crowded, map(np.random.default_rng, range(100))) if by_daqp(program)[1] >= 1]
    twice = [replace(one, A=np.vstack([one.A, one.A]), b=np.concatenate([one.b, one.b])) for one in feasible]
    assert max(np.abs(solve(one).x - solve(both).x).max() for one, both in zip(feasible, twice, strict=True)) < 1e-9
    assert len(parts) < 1.1 * 2 * len(feasible), "ProxQP solves a problem once"


def test_the_active_set_holds_no_row_with_nan():
    A, b = np.array([[1.0, 0.0], [np.nan, 1.0], [0.0, 1.0], [0.0, 0.0]]), np.array([-1.0, -5.0, np.nan, -1.0])
    assert hildreth_active_set(np.ones(2), np.zeros(2), A, b, 20).tolist() == [True, False, False, False]


def test_an_infeasible_verdict_on_few_rows_is_checked_on_all_rows(monkeypatch):
    """The solver is sometimes wrong about few rows."""
    program = next(one for one in map(crowded, map(np.random.default_rng, range(200))) if by_daqp(one)[1] >= 1)
    rows, whole = len(program.b), qp_solver._solved

    def hasty(part, index, **how):
        return whole(part, index, **how) if len(part.b) == rows else Solution(np.zeros(6), "primal_infeasible", 1)

    monkeypatch.setattr(qp_solver, "_solved", hasty)
    assert solve(program).status == "solved"


def test_a_rough_answer_to_few_rows_leads_to_the_solution(parts):
    """A quadrotor's program. By its residuals alone, ProxQP's own solution was off by 0.07 of an input's range."""
    stored = json.loads((Path(__file__).parents[1] / "stored" / "few-rows.json").read_text())
    program = QuadraticProgram(*(np.array(stored[name]) for name in ("h", "g", "A", "b")))
    ours, (theirs, flag) = solve(program), by_daqp(program)
    assert flag >= 1 and ours.status == "solved" and len(parts) == 1
    assert np.abs(ours.x - theirs)[:3].max() < 1e-6


@pytest.mark.parametrize("kind", ["residual", "set-membership", "matrix-zonotope"])
def test_another_solver_agrees(models, kind):
    feasible = 0
    for builder, program in programs(models[kind, "direct"], 150):
        ours = solve(program)
        theirs, flag = by_daqp(program)
        if flag < 1:
            assert ours.residual > 10 * ACCURACY or ours.status != "solved"
            continue
        feasible += 1
        assert ours.status == "solved"
        assert ours.residual <= 2 * ACCURACY
        assert np.abs(builder.inputs(ours.x) - builder.inputs(theirs)).max() < 1e-2  # where it hardly matters
        assert value(program, ours.x) == pytest.approx(value(program, theirs), abs=2e-3)
    assert feasible > 30


def test_the_residual_is_recomputed_from_the_rows_also_if_there_are_none_or_no_solution():
    bounded = QuadraticProgram(np.ones(2), np.array([-1.0, -1.0]), np.eye(2), np.array([0.5, 2.0]))
    solution = solve(bounded)
    assert solution.x == pytest.approx([0.5, 1.0], abs=1e-5)
    assert solution.residual == (bounded.A @ solution.x - bounded.b).max()
    free = solve(QuadraticProgram(np.ones(2), np.array([-1.0, 2.0]), np.zeros((0, 2)), np.zeros(0)))
    assert free.status == "solved" and free.x == pytest.approx([1.0, -2.0], abs=1e-6)
    impossible = solve(QuadraticProgram(np.ones(1), np.zeros(1), np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])))
    assert impossible.residual > 0.5 and not impossible.found


@pytest.mark.parametrize("kind", ["residual", "matrix-zonotope"])
def test_rows_that_the_presolve_drops_change_no_solution(models, kind, monkeypatch):
    pruned = [program for _, program in programs(models[kind, "direct"], 150)]
    monkeypatch.setattr(QPBuilder, "reachable", lambda self, before: (np.zeros(self.free), np.full(self.free, 1e3)))
    full = [program for _, program in programs(models[kind, "direct"], 150)]
    assert sum(len(program.b) for program in pruned) < 0.7 * sum(len(program.b) for program in full)
    left_out = 0
    for program in full:
        answers = [solve(other) for other in pruned if np.array_equal(other.g, program.g)]
        whole = by_daqp(program)
        if not answers:
            left_out += 1
            assert whole[1] < 1, "the presolve dropped a feasible program"
        elif whole[1] >= 1:
            assert value(program, answers[0].x) == pytest.approx(value(program, whole[0]), abs=2e-3)
            assert np.allclose(answers[0].x[:2], whole[0][:2], atol=4e-2)  # of the range
    assert left_out == len(full) - len(pruned)
