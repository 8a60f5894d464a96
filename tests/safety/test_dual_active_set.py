"""The solver of a batch of QPs gives the single solver's solutions."""

import numpy as np
import pytest

from brakeline.safety.filter.batch.dual_active_set import solve_batch
from brakeline.safety.filter.qp_solver import SOLVED, solve
from tests.safety.test_qp_solver import crowded


def test_the_solver_solves_exactly_or_proves_that_there_is_no_solution_whatever_rows_it_guesses():
    programs = [crowded(np.random.default_rng(seed)) for seed in range(150)]
    h = programs[0].h[:, None]
    g, A, b = (np.stack([getattr(one, name) for one in programs], axis=-1) for name in ("g", "A", "b"))
    cold = solve_batch(np, h, g, A, b, np.zeros((0, len(programs)), dtype=int))
    for lane, program in enumerate(programs):
        single = solve(program)
        solvable = single.status == SOLVED
        assert not (cold.solved[lane] and not solvable) and not (cold.infeasible[lane] and solvable)
        if cold.solved[lane]:
            assert np.abs(cold.x[:, lane] - single.x).max() < 1e-7
    assert 0.9 * len(programs) < (cold.solved | cold.infeasible).sum()
    assert cold.solved.sum() > 10 and cold.infeasible.sum() > 10
    guess = np.random.default_rng(0).integers(0, A.shape[0], (3, len(programs)))
    with np.errstate(all="ignore"):  # guessed rows may depend on each other
        warm = solve_batch(np, h, g, A, b, guess)
    both = cold.solved & warm.solved
    assert both.sum() > 10 and (cold.solved == warm.solved).mean() > 0.95
    assert np.abs(cold.x - warm.x)[:, both].max() < 1e-8


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_problem_that_is_not_finite_is_not_solved(value):
    A, b = np.array([[1.0], [value]])[..., None], np.array([[0.5], [0.5]])
    with np.errstate(all="ignore"):
        solution = solve_batch(np, np.ones((1, 1)), -np.ones((1, 1)), A, b, np.zeros((0, 1), dtype=int))
    assert not solution.solved[0]
