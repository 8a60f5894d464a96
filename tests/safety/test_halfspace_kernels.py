"""Compiled checks of a tube against half-spaces agree with the definitions and with random plans."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.safety.filter.kernels.halfspace_kernels import filled_by_plans, presolve_rows
from brakeline.safety.filter.qp import ObstacleRows
from brakeline.safety.filter.reachable_tube import Tube

SEEDS = st.integers(0, 2**32 - 1)


def a_tube(rng: np.random.Generator, d: int, own: bool = True) -> Tube:
    """own: each period has generators of its own, as in `stack_direct`."""
    N, nz, L, q = int(rng.integers(1, 6)), int(rng.integers(3, 8)), int(rng.integers(1, 9)), int(rng.integers(1, 6))
    directions = rng.normal(size=(N, d, L))
    if own:
        directions *= (np.arange(L) % N == np.arange(N)[:, None])[:, None, :]
    magnitudes = np.abs(rng.normal(size=(L + N + 1, q)))
    nothing = np.zeros((N, 0, nz)), np.zeros((N, 0, L))
    m_0 = np.abs(rng.normal(size=L + N + 1))
    constant = rng.normal(size=(N, d)), np.zeros((N, 0))
    return Tube(rng.normal(size=(N, d, nz)), directions, rng.normal(size=(q, nz)), magnitudes, m_0, *nothing, *constant)


def supports(tube: Tube, normals: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the supports (n, 2N+1) of the sets at both ends of all periods, by the definition in `ObstacleRows`."""
    N, L, sizes = tube.horizon, tube.generators, tube.magnitudes(z)
    centers = np.vstack([np.zeros(normals.shape[2]), tube.centers(z)])
    spans = np.concatenate([np.zeros((1, *tube.directions.shape[1:])), tube.directions])
    ends = [(k, k, L + k) for k in range(N)] + [(k, k + 1, L + k) for k in range(N)] + [(N - 1, N, L + N)]
    told = [
        normals[:, period] @ centers[end] + np.abs(normals[:, period] @ spans[end]) @ sizes[:L] + sizes[about]
        for period, end, about in ends
    ]
    return np.array(told).T


@pytest.mark.parametrize("d", [2, 3])
@given(seed=SEEDS)
def test_rows_and_slack_agree_with_the_definition(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tube = a_tube(rng, d, own=bool(seed % 2))
    normals, offsets = rng.normal(size=(4, tube.horizon, d)), rng.normal(size=(4, tube.horizon))
    z = rng.normal(size=tube.W.shape[1])
    layout, center = ObstacleRows(tube.directions), (tube.position, tube.offset, tube.stretch)
    rows = layout.rows(center, normals, offsets, 1.0)
    period = [*range(tube.horizon), *range(tube.horizon), tube.horizon - 1]
    expected = (offsets[:, period] - supports(tube, normals, z)).ravel()
    assert rows.bound - rows.support(tube, z) == pytest.approx(expected, abs=1e-9)
    assert layout.slack(center, normals, offsets, tube.magnitudes(z), z) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("what", ["normals", "offsets", "z"])
def test_nan_in_any_input_leaves_no_slack(what: str) -> None:
    rng = np.random.default_rng(0)
    tube = a_tube(rng, 3)
    told = {
        "normals": rng.normal(size=(4, tube.horizon, 3)),
        "offsets": np.full((4, tube.horizon), 100.0),
        "z": rng.normal(size=tube.W.shape[1]),
    }
    told[what].flat[0] = np.nan
    z, center = told["z"], (tube.position, tube.offset, tube.stretch)
    left = ObstacleRows(tube.directions).slack(center, told["normals"], told["offsets"], tube.magnitudes(z), z)
    assert np.isnan(left).any()


@given(seed=SEEDS)
def test_the_presolve_drops_only_rows_that_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, known, free, L, q = 12, 3, 3, 5, 3
    gradient, spread = rng.normal(size=(rows, known + free)), np.abs(rng.normal(size=(rows, L)))
    spread *= rng.random(spread.shape) < 0.5
    z_0, constant = rng.normal(size=known), np.abs(rng.normal(size=L))
    M, center, radius = np.abs(rng.normal(size=(L, q))), rng.normal(size=free), rng.uniform(0.0, 1.0, free)
    W, offset, scale = rng.normal(size=(q, free)), rng.normal(size=q), rng.uniform(0.5, 2.0, free + q)
    f = center + radius * rng.uniform(-1.0, 1.0, (400, free))
    f[:8] = center + radius * np.array(np.meshgrid(*[[-1.0, 1.0]] * free)).reshape(free, -1).T
    t = np.abs(f @ W.T + offset)
    z = np.hstack([np.tile(z_0, (len(f), 1)), f])
    reached = z @ gradient.T + (constant + t @ M.T) @ spread.T  # (plans, rows)
    bound = rng.uniform(reached.min(axis=0) - 0.1, reached.max(axis=0) + 1.0)
    bound[::2] = reached.max(axis=0)[::2] - rng.uniform(0.0, 0.2, rows // 2)  # a corner or so is just beyond
    atom, give = W @ center + offset, np.abs(W) @ radius
    within = np.stack([np.maximum(np.abs(atom) - give, 0.0), np.abs(atom) + give])
    count, A, b = presolve_rows(gradient, spread, bound, z_0, constant, M, center, radius, within, scale, 1e-6)
    left = bound - 1e-6 - reached
    if count < 0:
        assert (left.min(axis=1) < 1e-9).all(), "infeasible: no plan meets all rows"
        return
    of_those = (b[:count] - (np.hstack([f, t]) / scale) @ A[:count].T).min(axis=1, initial=np.inf)
    assert ((left.min(axis=1) >= 0.0) == (of_those >= 0.0))[np.abs(left).min(axis=1) > 1e-9].all()


@pytest.mark.parametrize("d", [2, 3])
@given(seed=SEEDS)
def test_no_plan_leaves_the_boxes_of_all_plans(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tube = a_tube(rng, d, own=bool(seed % 2))
    nz, free = tube.W.shape[1], 2
    z, radius, beside = rng.normal(size=nz), rng.uniform(0.0, 1.0, free), rng.uniform(0.0, 0.2, d)
    start, angle, turn = rng.normal(size=d), rng.uniform(-3.0, 3.0), np.eye(d)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    whole = np.ascontiguousarray
    W_free, moved = whole(np.abs(tube.W[:, -free:])), whole(np.abs(tube.position[..., -free:]))
    spans = np.abs(tube.directions)
    parts = whole(tube.W), W_free, whole(tube.M), tube.m_0, whole(tube.position), tube.offset, moved, spans, 1.0
    low, high = filled_by_plans(*parts, z, radius, beside, start, turn)
    assert low.shape == (tube.horizon + 1, d)
    for share in rng.uniform(-1.0, 1.0, (50, free)):
        plan = z.copy()
        plan[-free:] += radius * share
        sizes, centers = tube.magnitudes(plan), np.vstack([np.zeros(d), tube.centers(plan)])
        signs = rng.choice([-1.0, 1.0], (20, tube.generators))
        reached = np.einsum("kdl,sl->skd", tube.directions, signs * sizes[: tube.generators])
        chord_deviation = float(sizes[tube.generators :].max())
        for end in range(tube.horizon + 1):
            points = centers[end] + (reached[:, end - 1] if end else np.zeros((1, d)))
            points = start + (points + (chord_deviation + beside) * rng.uniform(-1.0, 1.0, points.shape)) @ turn.T
            assert (points >= low[end] - 1e-9).all() and (points <= high[end] + 1e-9).all()
