"""The QP: the solver's answers meet the conditions of an optimum, or no input meets the rows."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog, nnls

from brakeline.messaging.obstacle import Shapes
from brakeline.safety.filter.halfspaces import half_spaces
from brakeline.safety.filter.qp import ObstacleRows, QPBuilder
from brakeline.safety.filter.qp_solver import SOLVED, TOLERANCE, QuadraticProgram, Solution, solve
from brakeline.safety.model.model_set import ModelSet
from tests.safety.asked import cylinder


def programs(model: ModelSet, count, seed=0):
    """QPs as the filter builds them, of proposals near obstacles."""
    rng = np.random.default_rng(seed)
    tube, outer = model.tube(), model.outer_tube()
    layout, builder = ObstacleRows(tube.directions), QPBuilder(model.robot, outer)
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


def off_optimum(program, x):
    """Return how far x is from meeting the conditions of an optimum: its rows, then the gradient of the Lagrangian."""
    left = program.A @ x - program.b
    active = program.A[left > -1e-7]
    return max(left.max(initial=0.0), 0.0), nnls(active.T, -(program.h * x + program.g))[1]


def least_violation(program):
    """Return the smallest number by which some row must be violated; negative if all rows can be met."""
    n = len(program.h)
    rows = np.hstack([program.A, -np.ones((len(program.b), 1))])
    found = linprog(np.eye(n + 1)[n], A_ub=rows, b_ub=program.b, bounds=[(None, None)] * n + [(-1.0, None)])
    return found.fun


def crowded(rng, rows=160, n=6):
    """Return a projection onto a body with many faces, some of them nearly equal. Sometimes the body is empty."""
    A = rng.normal(size=(rows, n))
    A[: rows // 2] = A[0] + 0.05 * A[: rows // 2]
    A = np.vstack([A / np.linalg.norm(A, axis=1, keepdims=True), np.eye(n), -np.eye(n)])
    b = A @ rng.uniform(-0.8, 0.8, n) + rng.uniform(-rng.uniform(0.0, 0.4), 0.8, len(A))
    b[-2 * n :] = 1.0
    return QuadraticProgram(np.array([1.0] * 3 + [1e-4] * 3), np.array([*rng.uniform(-2.0, 2.0, 3), 0, 0, 0]), A, b)


def test_a_solution_is_exact_or_there_is_none():
    impossible = 0
    for program in map(crowded, map(np.random.default_rng, range(200))):
        ours = solve(program)
        impossible += not ours.found
        if ours.found:
            assert ours.status == SOLVED and ours.residual <= TOLERANCE
            assert max(off_optimum(program, ours.x)) < 1e-8
            assert (solve(program).x == ours.x).all(), "it is deterministic"
        else:
            assert least_violation(program) > -1e-7
    assert 20 < impossible < 180


def test_a_stored_program_is_solved_exactly():
    """A quadrotor's program. An iterative solver, by its residuals alone, was off by 0.07 of an input's range."""
    stored = json.loads((Path(__file__).parents[1] / "stored" / "few-rows.json").read_text())
    program = QuadraticProgram(*(np.array(stored[name]) for name in ("h", "g", "A", "b")))
    assert max(off_optimum(program, solve(program).x)) < 1e-8


@pytest.mark.parametrize("kind", ["residual", "set-membership", "matrix-zonotope"])
def test_the_filters_programs_are_solved_exactly(models, kind):
    feasible = 0
    for _, program in programs(models[kind, "direct"], 150):
        ours = solve(program)
        feasible += ours.found
        if ours.found:
            assert max(off_optimum(program, ours.x)) < 1e-8
        else:
            assert least_violation(program) > -1e-7
    assert feasible > 30


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_program_that_is_not_finite_has_no_solution(value):
    one = np.ones(1)
    for parts in ((one * value, one[None], one), (one, one[None] * value, one), (one, one[None], one * value)):
        solution = solve(QuadraticProgram(one, *parts))
        assert not solution.found and solution.status == "not finite"


def test_an_infeasible_problem_has_no_solution():
    program = QuadraticProgram(np.ones(1), np.zeros(1), np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0]))
    solution = solve(program)
    assert not solution.found and solution.status == "infeasible" and solution.residual == np.inf


def test_a_program_without_rows_is_solved():
    solution = solve(QuadraticProgram(np.ones(2), np.array([-1.0, 2.0]), np.zeros((0, 2)), np.zeros(0)))
    assert solution.status == "solved" and solution.x == pytest.approx([1.0, -2.0], abs=1e-6)


def test_the_residual_is_recomputed_from_the_rows():
    program = QuadraticProgram(np.ones(2), np.array([-1.0, -1.0]), np.eye(2), np.array([0.5, 2.0]))
    solution = solve(program)
    assert solution.x == pytest.approx([0.5, 1.0], abs=1e-5)
    assert solution.residual == (program.A @ solution.x - program.b).max()
    assert not Solution(np.array([np.nan]), "solved", 1, 0.0).found


@pytest.mark.parametrize("kind", ["residual", "matrix-zonotope"])
def test_rows_that_the_presolve_drops_change_no_solution(models, kind, monkeypatch):
    pruned = [program for _, program in programs(models[kind, "direct"], 150)]
    monkeypatch.setattr(QPBuilder, "reachable", lambda self, before: (np.zeros(self.free), np.full(self.free, 1e3)))
    full = [program for _, program in programs(models[kind, "direct"], 150)]
    assert sum(len(program.b) for program in pruned) < 0.7 * sum(len(program.b) for program in full)
    left_out = 0
    for program in full:
        answers = [solve(other) for other in pruned if np.array_equal(other.g, program.g)]
        whole = solve(program)
        if not answers:
            left_out += 1
            assert not whole.found, "the presolve dropped a feasible program"
        else:
            assert answers[0].found == whole.found
            assert not whole.found or np.allclose(answers[0].x, whole.x, atol=1e-7)
    assert left_out == len(full) - len(pruned)
