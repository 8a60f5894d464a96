"""Each compiled kernel of the filter gives what its plain NumPy twin gives, and what its definition says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, Shapes
from brakeline.safety.filter import plan_inputs
from brakeline.safety.filter.kernels import (
    active_set_kernels,
    halfspace_kernels,
    qp_kernels,
    rollout_kernels,
    shape_kernels,
    tube_kernels,
    window_kernels,
    window_rollout_kernels,
)
from brakeline.safety.filter.qp import ObstacleRows
from brakeline.safety.filter.reachable_tube import Tube
from tests.safety import kernel_twins

N, L, Q, NZ, FREE = 4, 5, 6, 7, 3  # periods, generators, rows of W, regressors, free inputs
MAGNITUDES = L + N + 1
MODULES = (
    halfspace_kernels,
    qp_kernels,
    tube_kernels,
    active_set_kernels,
    plan_inputs,
    rollout_kernels,
    shape_kernels,
    window_kernels,
    window_rollout_kernels,
)


def half_space_parts(rng, d):
    """Eight half-spaces and the 2N + 1 ends of an `ObstacleRows`, without one order among the generators."""
    ends, used = 2 * N + 1, 3
    period = rng.integers(0, N, ends)
    columns = np.array([rng.choice(L, used, replace=False) for _ in range(ends)])
    end, end_directions = rng.integers(0, N + 1, ends), rng.normal(size=(ends, d, used))
    extra, stretch = L + rng.integers(0, N + 1, ends), rng.uniform(1.0, 2.0, N) if rng.random() < 0.5 else np.zeros(0)
    half_spaces = rng.normal(size=(8, N, d)), rng.normal(size=(8, N))
    center = rng.normal(size=(N, d, NZ)), rng.normal(size=(N, d)), stretch
    return *half_spaces, *center, end, period, end_directions, columns, extra


def tube_parts(rng, d):
    """W and M transposed, m_0, position, offset, directions, widening."""
    W_t, M_t, m_0 = rng.normal(size=(NZ, Q)), rng.random((Q, MAGNITUDES)), rng.random(MAGNITUDES)
    return W_t, M_t, m_0, rng.normal(size=(N, d, NZ)), rng.normal(size=(N, d)), rng.normal(size=(N, d, L)), 1.3


def rollout_parts(rng, d):
    """A predictor of one period for a robot with a heading, two speeds, two inputs and a further disc."""
    variables, terms = 6, rng.integers(0, 9, (12, 4))
    saturations = np.array([[2.0, 0.0, 0.7], [3.0, -1.0, 0.5]])
    arms = rng.normal(size=(1, d))
    others = np.array([d + 1, d + 2])
    C = 0.1 * rng.normal(size=(d + 3, len(terms)))  # products of four grow fast
    return C, rng.uniform(0.5, 2.0, variables), saturations, terms, others, d, arms, d, 2


def presolve_arguments(rng, room):
    """Twenty rows; the larger `room` is, the more of them no input can violate."""
    spread = rng.random((20, MAGNITUDES)) * (rng.random((20, MAGNITUDES)) < 0.5)
    gradient, bound = rng.normal(size=(20, NZ)), rng.normal(size=20) + room
    M, atoms = rng.random((MAGNITUDES, Q)), np.sort(rng.random((2, Q)), axis=0)
    known = rng.normal(size=NZ - FREE), rng.random(MAGNITUDES)
    inputs = rng.normal(size=FREE), rng.random(FREE)
    fixed = rng.normal(size=(4, FREE + Q)), rng.normal(size=4), rng.normal(size=(4, NZ - FREE))
    return gradient, spread, bound, *known, M, *inputs, atoms, rng.uniform(0.5, 2.0, FREE + Q), 1e-6, *fixed


def shapes(rng, d):
    """Obstacles of every kind, about a start at the origin that some of them touch."""
    size = rng.uniform(0.1, 1.0, 3)
    upright = (*size[:2],) if d == 3 else (size[0],)
    found = [
        Obstacle(BOX, tuple(rng.normal(size=d)), tuple(size[:d]), rng.uniform(-3.0, 3.0)),
        Obstacle(CYLINDER, tuple(rng.normal(size=d)), upright, margin=rng.uniform(-0.2, 0.2)),
        Obstacle(SPHERE, tuple(rng.normal(size=d)), (size[0],)),
        Obstacle(WALL, tuple(rng.normal(size=d)), (), rng.uniform(-3.0, 3.0)),
    ]
    return Shapes.of(found, d)


def impaired(rng, near):
    """Return the arrays of obstacles, one number of which is often wrong."""
    parts = [part.copy() for part in (*near.parts, near.margin)]
    part = parts[rng.integers(len(parts))].reshape(-1)
    place = rng.integers(len(part))
    part[place] = rng.choice([part[place], np.nan, np.inf, -1e6, -1.0, 0.5, 1e200])
    return parts


def cases(rng, d):
    """Arguments for each kernel, by its name."""
    W_t, M_t, m_0, position, offset, directions, widening = tube = tube_parts(rng, d)
    z, start, turn = rng.normal(size=NZ), rng.normal(size=d), kernel_twins.turning(rng.uniform(-3.0, 3.0), d)
    parts, measured = half_space_parts(rng, d), rng.random(d)
    plans = np.abs(W_t.T[:, -FREE:]), np.abs(position[..., -FREE:]), np.abs(directions)
    low, high, slew = np.array([-1.0, 0.0]), np.array([1.0, 0.3]), np.array([0.2, np.inf])
    before, bounds = rng.uniform(low, high), np.stack([z - rng.uniform(-0.05, 1.0), z + 1.0])
    h, g, A, b = rng.uniform(0.1, 1.0, FREE), rng.normal(size=FREE), rng.normal(size=(30, FREE)), rng.normal(size=30)
    step = rng.normal(size=(9, NZ)), W_t, M_t[:, :9], rng.random((NZ, 9)), m_0[:9], rng.random((9, 9))
    predictor, root, weight = rollout_parts(rng, d), np.tril(rng.normal(size=(12, 12))), rng.uniform(0.0, 3.0)
    plan = 0.5 * rng.normal(size=6), rng.normal(size=(2 + 2 + 2 * N, 6)) / 3.0
    presolve = presolve_arguments(rng, rng.uniform(0.0, 12.0))
    rows = presolve[:3]
    near, path = shapes(rng, d), np.vstack([np.zeros(d), np.cumsum(0.3 * rng.normal(size=(N, d)), axis=0)])
    return {
        "rows": (*parts, MAGNITUDES, widening),
        "slack": (*parts, rng.random(MAGNITUDES), z),
        "least": (rng.normal(size=30), 0.5),
        "row_slack": (*rows, z, rng.random(MAGNITUDES)),
        "tightened": (*rows, rng.random(20), rng.random(20) < 0.4, rng.random(NZ) < 0.5, z, 1e-6),
        "atom_range": (W_t.T[:, FREE:], W_t.T[:, :FREE], z[FREE:], rng.normal(size=FREE), rng.random(FREE)),
        "presolved_rows": presolve,
        "reachable": (low, high, np.arange(1.0, 4.0)[:, None] * slew, before),
        "filled_by_plans": (
            *(W_t.T, plans[0], M_t.T, m_0, position, offset, *plans[1:], widening),
            *(z, rng.random(FREE), measured, start, turn),
        ),
        "within": (z, bounds),
        "magnitudes": (W_t, M_t, m_0, z),
        "places": (position, offset, z, start, turn),
        "sets": (*tube, z, start, turn, measured),
        "extent": (*tube, z, 0.105),
        "next_state": (*step, z, rng.normal(size=9), rng.uniform(1.0, 2.0, 9), start, turn),
        "rollout": (predictor, root.T, weight, 0.5 * rng.normal(size=2 + 2 + 2 * N)),
        "rollouts": (predictor, root, weight, 0.5 * rng.normal(size=(5, 2 + 2 + 2 * N)), int(rng.integers(N))),
        "affine": (predictor, *plan, np.array([d + 1, d])),
        "sets_around": (
            *(predictor, root.T, weight, plan[1], np.array([d + 1, d]), directions),
            *(rng.normal(size=(N, 2, L)), plan[0]),
        ),
        "score": (
            *(predictor, root.T, weight, rng.normal(size=(N + 1, d + 3)), 0.5 * rng.normal(size=(N + 1, 2))),
            *(rng.normal(size=(Q, 2 + 2 + 2 * N)), rng.random((N, 2 * d + 3, Q))),
            *(rng.random((N, 2 * d + 3, 2 + 2 + 2 * N)), rng.random((N, 2 * d + 3)), np.array([*range(d), d + 3])),
        ),
        "linearized": (predictor, plan[1] @ plan[0], plan[1]),
        "distances": (*near.parts, start),
        "plausible": (*impaired(rng, near),),
        "parted": (rng.choice([0.1, 0.5, 0.7, np.nan], 6), 0.6, 0.3),
        "roomiest_planes": (rng.normal(size=(6, 2 * N + 1, d)), rng.normal(size=(6, 2 * N + 1)) + 1.0, path),
        "planes_beside": (*near.parts, near.margin, start, start + path[1:], 0.1, measured),
        "hildreth_active_set": (h, g, A, b, 20),
        "likely_rows": (h, g, A, b, 4, 20),
        "carrying_rows": (rng.choice([-1.0, 0.0, 0.5, 0.5, 2.0], 12), rng.permutation(30)[:12], 1e-7),
        "exact_solution": (h, g, A, b + rng.choice([0.0, 1.0]), rng.permutation(30)[:8]),
        "clip_to_bounds": (rng.normal(size=2), before, low, high, slew),
        "regressors_of_braking": (z, rng.random((3, 2)), rng.normal(size=2)),
    }


def test_every_kernel_has_a_twin_and_a_case():
    names = {name for module in MODULES for name, f in vars(module).items() if hasattr(f, "py_func") and name[0] != "_"}
    assert names == set(cases(np.random.default_rng(0), 2))
    assert all(callable(getattr(kernel_twins, name)) for name in names)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", range(40))
def test_each_kernel_gives_what_its_plain_twin_gives(seed, d):
    kernels = {name: function for module in MODULES for name, function in vars(module).items()}
    for name, values in cases(np.random.default_rng(seed), d).items():
        arguments = [np.ascontiguousarray(x) if isinstance(x, np.ndarray) and x.ndim else x for x in values]
        ours, plain = kernels[name](*arguments), getattr(kernel_twins, name)(*arguments)
        if name == "presolved_rows":
            count = ours[0]
            ours = count, ours[1][: max(count, 0)], ours[2][: max(count, 0)]
        ours, plain = (value if isinstance(value, tuple) else (value,) for value in (ours, plain))
        close = 1e-5 if name in ("linearized", "affine") else 1e-9  # its twin differentiates numerically
        for one, other in zip(ours, plain, strict=True):
            np.testing.assert_allclose(one, other, rtol=close, atol=close, err_msg=name)


def test_the_presolve_cases_have_rows_that_rule_out_and_rows_that_are_left():
    counts = {kernel_twins.presolved_rows(*cases(np.random.default_rng(s), 2)["presolved_rows"])[0] for s in range(40)}
    assert -1 in counts and 4 < max(counts) <= 24


def test_a_value_that_is_not_a_number_is_never_the_least():
    assert np.isnan(halfspace_kernels.least(np.array([1.0, np.nan, -1.0]), 0.5))
    assert not tube_kernels.within(np.array([0.0, np.nan]), np.array([[-1.0, -1.0], [1.0, 1.0]]))


# --- the rows of a tube against half-spaces, by their definitions --------------------------------------------------

SEEDS = st.integers(0, 2**32 - 1)


def a_tube(rng, d, own=True):
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


def supports(tube, normals, z):
    """Return the supports (n, 2N+1) of the sets at both ends of all periods, by the definition in `ObstacleRows`."""
    N, L, sizes = tube.horizon, tube.generators, tube.magnitudes(z)
    centers = np.vstack([np.zeros(normals.shape[2]), tube.centers(z)])
    spans = np.concatenate([np.zeros((1, *tube.directions.shape[1:])), tube.directions])
    ends = [(k, k, L + k) for k in range(N)] + [(k, k + 1, L + k) for k in range(N)] + [(N - 1, N, L + N)]
    values = [
        normals[:, period] @ centers[end] + np.abs(normals[:, period] @ spans[end]) @ sizes[:L] + sizes[about]
        for period, end, about in ends
    ]
    return np.array(values).T


@pytest.mark.parametrize("d", [2, 3])
@given(seed=SEEDS)
def test_rows_and_slack_agree_with_the_definition(d, seed):
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


def test_nan_in_any_input_leaves_no_slack():
    rng = np.random.default_rng(0)
    tube = a_tube(rng, 3)
    center, layout = (tube.position, tube.offset, tube.stretch), ObstacleRows(tube.directions)
    parts = rng.normal(size=(4, tube.horizon, 3)), np.full((4, tube.horizon), 100.0), rng.normal(size=tube.W.shape[1])
    for number in range(len(parts)):
        normals, offsets, z = (part.copy() for part in parts)
        (normals, offsets, z)[number].flat[0] = np.nan
        assert np.isnan(layout.slack(center, normals, offsets, tube.magnitudes(z), z)).any()


@pytest.mark.parametrize("d", [2, 3])
@settings(max_examples=40)
@given(seed=SEEDS)
def test_no_plan_leaves_the_boxes_of_all_plans(d, seed):
    rng = np.random.default_rng(seed)
    tube = a_tube(rng, d, own=bool(seed % 2))
    free, whole = 2, np.ascontiguousarray
    z, radius, beside = rng.normal(size=tube.W.shape[1]), rng.uniform(0.0, 1.0, free), rng.uniform(0.0, 0.2, d)
    start, turn = rng.normal(size=d), kernel_twins.turning(rng.uniform(-3.0, 3.0), d)
    W_free, moved = whole(np.abs(tube.W[:, -free:])), whole(np.abs(tube.position[..., -free:]))
    spans = np.abs(tube.directions)
    parts = whole(tube.W), W_free, whole(tube.M), tube.m_0, whole(tube.position), tube.offset, moved, spans, 1.0
    low, high = halfspace_kernels.filled_by_plans(*parts, z, radius, beside, start, turn)
    assert low.shape == (tube.horizon + 1, d)
    for share in rng.uniform(-1.0, 1.0, (20, free)):
        plan = z.copy()
        plan[-free:] += radius * share
        sizes, points = tube.magnitudes(plan), np.vstack([np.zeros(d), tube.centers(plan)])  # (N + 1, d)
        signs = rng.choice([-1.0, 1.0], (20, tube.generators))
        points = np.tile(points, (len(signs), 1, 1))
        points[:, 1:] += np.einsum("kdl,sl->skd", tube.directions, signs * sizes[: tube.generators])
        chord_deviation = float(sizes[tube.generators :].max())
        points = start + (points + (chord_deviation + beside) * rng.uniform(-1.0, 1.0, points.shape)) @ turn.T
        assert (points >= low - 1e-9).all() and (points <= high + 1e-9).all()
