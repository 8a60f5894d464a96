"""What the benchmark `groups` counts and states, and its jumping inputs."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom

from benchmarks.driving_groups import MOST_HELD, Containment, JumpingPolicy, lower_bound
from tests.robots import GROUND


def test_plans_and_steps_outside_are_counted_beside_what_is_stated():
    counts = Containment()
    for score in (0.2, 1.0, 1.5, np.nan):
        counts.plan(score)
    for inside in (True, True, False):
        counts.step(inside)
    figures = counts.figures(SimpleNamespace(about={"bound_plan": "0.01", "bound_step": "0.002"}))
    assert (figures["plans"], figures["plans outside"], figures["plans [%]"]) == (4, 2, 50.0)
    assert (figures["steps"], figures["steps outside"]) == (3, 1)
    assert (figures["plans, stated at most [%]"], figures["steps, stated at most [%]"]) == (1.0, 0.2)


@pytest.mark.parametrize(("outside", "count"), [(1, 2500), (7, 2500), (2500, 2500)])
def test_so_many_outside_have_a_chance_of_one_in_a_hundred_at_the_lower_bound(outside, count):
    assert binom.sf(outside - 1, count, lower_bound(outside, count)) == pytest.approx(0.01)
    assert lower_bound(0, count) == 0.0


def test_jumping_inputs_are_held_for_one_to_three_periods_at_the_bounds():
    policy = JumpingPolicy(GROUND, np.random.default_rng(0))
    inputs = np.array([policy(None, {}) for _ in range(3000)])
    assert set(map(tuple, inputs)) == {(v, w) for v in (0.0, 0.25) for w in (-0.5, 0.5)}
    changes = np.flatnonzero((np.diff(inputs, axis=0) != 0.0).any(1))
    assert 0.3 < len(changes) / len(inputs) < 0.5 and MOST_HELD == 3
