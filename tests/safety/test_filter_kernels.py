"""Each compiled kernel of the filter gives what its plain NumPy twin gives."""

import numpy as np
import pytest

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, Shapes
from brakeline.safety.filter import plan_inputs
from brakeline.safety.filter.kernels import (
    active_set_kernels,
    halfspace_kernels,
    rollout_kernels,
    shape_kernels,
    tube_kernels,
    window_kernels,
    window_rollout_kernels,
)
from tests.safety import kernel_twins

N, L, Q, NZ, FREE = 4, 5, 6, 7, 3  # periods, generators, rows of W, regressors, free inputs
MAGNITUDES = L + N + 1
MODULES = (
    halfspace_kernels,
    tube_kernels,
    active_set_kernels,
    plan_inputs,
    rollout_kernels,
    shape_kernels,
    window_kernels,
    window_rollout_kernels,
)


def turned(rng, d):
    """A rotation (d, d) about the vertical axis."""
    angle, turn = rng.uniform(-3.0, 3.0), np.eye(d)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return turn


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
    variables, terms = 6, rng.integers(0, 9, (12, 3))
    saturations = np.array([[2.0, 0.0, 0.7], [3.0, -1.0, 0.5]])
    arms = rng.normal(size=(1, d))
    others = np.array([d + 1, d + 2])
    C = 0.3 * rng.normal(size=(d + 3, len(terms)))
    return C, rng.uniform(0.5, 2.0, variables), saturations, terms, others, d, arms, d, 2


def presolve_arguments(rng, room):
    """Twenty rows; the larger `room` is, the more of them no input can violate."""
    spread = rng.random((20, MAGNITUDES)) * (rng.random((20, MAGNITUDES)) < 0.5)
    gradient, bound = rng.normal(size=(20, NZ)), rng.normal(size=20) + room
    M, atoms = rng.random((MAGNITUDES, Q)), np.sort(rng.random((2, Q)), axis=0)
    known = rng.normal(size=NZ - FREE), rng.random(MAGNITUDES)
    inputs = rng.normal(size=FREE), rng.random(FREE)
    return gradient, spread, bound, *known, M, *inputs, atoms, rng.uniform(0.5, 2.0, FREE + Q), 1e-6


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


def cases(rng, d):
    """Arguments for each kernel, by its name."""
    W_t, M_t, m_0, position, offset, directions, widening = tube = tube_parts(rng, d)
    z, start, turn = rng.normal(size=NZ), rng.normal(size=d), turned(rng, d)
    parts, measured = half_space_parts(rng, d), rng.random(d)
    plans = np.abs(W_t.T[:, -FREE:]), np.abs(position[..., -FREE:]), np.abs(directions)
    low, high, slew = np.array([-1.0, 0.0]), np.array([1.0, 0.3]), np.array([0.2, np.inf])
    before, bounds = rng.uniform(low, high), np.stack([z - rng.uniform(-0.05, 1.0), z + 1.0])
    h, g, A, b = rng.uniform(0.1, 1.0, FREE), rng.normal(size=FREE), rng.normal(size=(30, FREE)), rng.normal(size=30)
    step = rng.normal(size=(9, NZ)), W_t, M_t[:, :9], rng.random((NZ, 9)), m_0[:9], rng.random((9, 9))
    predictor, leverage = rollout_parts(rng, d), (np.tril(rng.normal(size=(12, 12))), rng.uniform(0.0, 3.0))
    plan = 0.5 * rng.normal(size=6), rng.normal(size=(2 + 2 + 2 * N, 6)) / 3.0
    near, path = shapes(rng, d), np.vstack([np.zeros(d), np.cumsum(0.3 * rng.normal(size=(N, d)), axis=0)])
    return {
        "rows": (*parts, MAGNITUDES, widening),
        "slack": (*parts, rng.random(MAGNITUDES), z),
        "least": (rng.normal(size=30), 0.5),
        "presolve_rows": presolve_arguments(rng, rng.uniform(0.0, 12.0)),
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
        "next_state": (*step, z, rng.normal(size=9), widening, start, turn),
        "rollout": (predictor, 0.5 * rng.normal(size=2 + 2 + 2 * N)),
        "stretch": (predictor, *leverage, 0.5 * rng.normal(size=2 + 2 + 2 * N)),
        "rollouts": (predictor, 0.5 * rng.normal(size=(5, 2 + 2 + 2 * N))),
        "stretches": (predictor, *leverage, 0.5 * rng.normal(size=(5, 2 + 2 + 2 * N))),
        "affine": (predictor, *plan, np.array([d + 1, d])),
        "sets_around": (
            *(predictor, *leverage, plan[1], np.array([d + 1, d]), directions, rng.normal(size=(N, 2, L)), plan[0]),
        ),
        "score": (
            *(predictor, *leverage, rng.normal(size=(N + 1, d + 3)), 0.5 * rng.normal(size=(N + 1, 2))),
            *(rng.normal(size=(Q, 2 + 2 + 2 * N)), rng.random((N, d + 3, Q))),
            *(rng.random((N, d + 3, 2 + 2 + 2 * N)), rng.random((N, d + 3)), np.arange(d)),
        ),
        "linearized": (predictor, *plan),
        "distances": (*near.parts, start),
        "parted": (rng.choice([0.1, 0.5, 0.7, np.nan], 6), 0.6, 0.3),
        "roomiest_planes": (rng.normal(size=(6, 2 * N + 1, d)), rng.normal(size=(6, 2 * N + 1)) + 1.0, path),
        "planes_beside": (*near.parts, near.margin, start, start + path[1:], 0.1, measured),
        "hildreth_active_set": (h, g, A, b, 20),
        "clip_to_bounds": (rng.normal(size=2), before, low, high, slew),
        "regressors_of_braking": (z, rng.random((3, 2)), rng.normal(size=2)),
    }


def public_kernels():
    """All public kernels, by name."""
    named = {}
    for module in MODULES:
        named |= {name: f for name, f in vars(module).items() if hasattr(f, "py_func") and not name.startswith("_")}
    return named


def test_every_kernel_has_a_twin_and_a_case():
    names = set(public_kernels())
    assert names == set(cases(np.random.default_rng(0), 2))
    assert all(callable(getattr(kernel_twins, name)) for name in names)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", sorted(cases(np.random.default_rng(0), 2)))
def test_a_kernel_gives_what_its_plain_twin_gives(name, d):
    kernel = next(getattr(module, name) for module in MODULES if hasattr(module, name))
    twin = getattr(kernel_twins, name)
    for seed in range(40):
        arguments = cases(np.random.default_rng(seed), d)[name]
        arguments = [np.ascontiguousarray(x) if isinstance(x, np.ndarray) and x.ndim else x for x in arguments]
        ours, plain = kernel(*arguments), twin(*arguments)
        if name == "presolve_rows":
            count = ours[0]
            ours = count, ours[1][: max(count, 0)], ours[2][: max(count, 0)]
        ours, plain = (value if isinstance(value, tuple) else (value,) for value in (ours, plain))
        for one, other in zip(ours, plain, strict=True):
            close = 1e-5 if name in ("linearized", "affine") else 1e-9  # its twin differentiates numerically
            np.testing.assert_allclose(one, other, rtol=close, atol=close)


def test_the_presolve_cases_have_rows_that_rule_out_and_rows_that_are_left():
    counts = {kernel_twins.presolve_rows(*cases(np.random.default_rng(s), 2)["presolve_rows"])[0] for s in range(40)}
    assert -1 in counts and 0 < max(counts) <= 20


def test_a_value_that_is_not_a_number_is_never_the_least():
    assert np.isnan(halfspace_kernels.least(np.array([1.0, np.nan, -1.0]), 0.5))
    assert not tube_kernels.within(np.array([0.0, np.nan]), np.array([[-1.0, -1.0], [1.0, 1.0]]))
