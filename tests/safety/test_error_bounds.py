"""The three error bounds: published sets, known noise, and the relations between them."""

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from brakeline.errors import ErrorBoundError
from brakeline.safety.filter.reachable_tube import RecursionMaps, stack_recursive
from brakeline.safety.model.envelopes import Envelopes
from brakeline.safety.model.error_bounds import (
    ErrorBound,
    least_squares,
    matrix_zonotope,
    residual,
    set_membership,
    whitening,
)
from brakeline.safety.model.linear_program import LinearProgram
from brakeline.safety.model.validation import facet_normals
from tests.safety.linear import PUBLISHED, count_outside, double_integrator, lti5

pytestmark = pytest.mark.fast

HORIZON = 5
SYSTEMS = {"lti5": lti5(), "lti5-measured": lti5(v_half=0.0005), "double-integrator": double_integrator()}
EACH_SYSTEM = pytest.mark.parametrize("name", SYSTEMS)


def matrix_hull(bound: ErrorBound) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval hull of all matrices C + Σ_j g_j (M_j β) W with |β| <= 1."""
    half = np.abs(bound.generators) @ bound.M @ np.abs(bound.W)
    return bound.C - half, bound.C + half


def measured_noise(z: np.ndarray, y: np.ndarray, w_half: np.ndarray, v_half: np.ndarray) -> np.ndarray:
    """Return half-widths of w + v⁺ - A v for a linear system with box noise and unknown A (docs/method.md §1).

        |A v| <= s = (|C_A| v̄ + γ (w̄ + v̄)) / (1 - γ),    γ = Σ_i v̄_i ‖Z⁺_{:,i}‖₁,    with the state first in z.

    Args:
        z: (T, nz) measured regressors; y: (T, n); w_half, v_half: (n,).

    Raises:
        ErrorBoundError: γ >= 1: the measurements are too noisy for the data to bound A.
    """
    n = y.shape[1]
    pseudo = np.linalg.pinv(z.T)
    gamma = float(v_half @ np.abs(pseudo[:, :n]).sum(0))
    if gamma >= 1.0:
        raise ErrorBoundError(f"γ = {gamma:.3g} >= 1: the measurement noise is too large for a bound on A v")
    C = y.T @ pseudo
    s = (np.abs(C[:, :n]) @ v_half + gamma * (w_half + v_half)) / (1.0 - gamma)
    return np.asarray(w_half + v_half + s)


@cache
def certificates(name, **size):
    """Return both error bounds of a linear system whose noise is known to lie in a box."""
    system = SYSTEMS[name]
    z, y = system.data(0, **size)
    half = np.abs(system.G).sum(1)
    if system.v_half.any():
        half = measured_noise(z, y, half, system.v_half)
    n, nz = y.shape[1], z.shape[1]
    sizes, kappa = np.tile(half[:, None], len(z)), np.zeros((n, nz))
    return {
        "matrix-zonotope": matrix_zonotope(z, y, np.eye(n), sizes, kappa, half),
        "set-membership": set_membership(z, y, sizes, kappa, half),
    }


# --- published sets ----------------------------------------------------------------------------------------------


def test_published_model_set_of_the_double_integrator():
    truth = PUBLISHED["tzpc_double_integrator"]
    z = np.vstack([truth["X0"], truth["U"]]).T
    y, generators = np.array(truth["X1"]).T, np.array(truth["W_gen"])
    bound = matrix_zonotope(z, y, generators, np.ones((2, len(z))), np.zeros((2, 3)), np.ones(2))
    low, high = matrix_hull(bound)
    assert np.allclose(low, truth["M_sigma_lo"], atol=1e-8)
    assert np.allclose(high, truth["M_sigma_hi"], atol=1e-8)


def test_published_reachable_set_of_the_five_dimensional_system():
    truth = PUBLISHED["cora_linear_dt_5d"]
    n, k = 5, truth["k"]
    A, half = np.array(truth["A"]), np.array(truth["e_half"])
    step = ErrorBound(A, np.zeros((0, n)), np.zeros((n, 0)), np.zeros((n, n)), half, np.eye(n))
    how = RecursionMaps(tuple(range(n)), 0, 0, np.zeros((0, 0)), np.eye(n))
    start = replace(step, C=np.eye(n), w=np.ones(n), generators=truth["x0_half"] * np.eye(n))  # leads to the first set
    tube = stack_recursive([start, *[step] * k], how, n)
    middle = np.array(truth["x0_center"], float)
    center, width = tube.centers(middle)[-1], tube.half_widths(middle)[-1]
    assert np.allclose(center - width, truth["lo"], atol=1e-8)
    assert np.allclose(center + width, truth["hi"], atol=1e-8)


# --- known noise: nothing outside ---------------------------------------------------------------------------------


@EACH_SYSTEM
def test_no_noise_sequence_leaves_the_tube(name):
    system, rng = SYSTEMS[name], np.random.default_rng(7)
    tubes = [system.tube(bound, HORIZON) for bound in certificates(name).values()]
    n, m = system.B.shape
    directions = np.vstack([np.eye(n), rng.normal(size=(30, n))])
    for i in range(20):
        y_0 = rng.normal(size=n)
        plan = system.center + rng.uniform(-system.swing, system.swing, (HORIZON, m))
        states = system.rollouts(rng, y_0, plan, 250, worst=bool(i % 2))
        z = np.concatenate([y_0, np.zeros(m), plan.ravel()])
        assert [count_outside(tube, z, states, directions) for tube in tubes] == [0, 0]


def test_noise_sequences_leave_a_tube_of_half_the_noise():
    system, bound = SYSTEMS["lti5"], certificates("lti5")["set-membership"]
    narrow = ErrorBound(bound.C, bound.W, 0.0 * bound.M, bound.kappa, 0.5 * bound.w, bound.generators)
    rng = np.random.default_rng(7)
    plan = np.full((HORIZON, 1), 8.0)
    states = system.rollouts(rng, np.zeros(5), plan, 1000, worst=True)
    tube = system.tube(narrow, HORIZON)
    assert count_outside(tube, np.concatenate([np.zeros(6), plan.ravel()]), states, np.eye(5)) > 100


@EACH_SYSTEM
def test_the_true_matrices_are_in_both_sets(name):
    truth = np.hstack([SYSTEMS[name].A, SYSTEMS[name].B])
    z = np.random.default_rng(3).normal(size=(200, truth.shape[1]))
    for bound in certificates(name).values():
        off = np.abs(z @ (truth - bound.C).T)
        assert (off <= np.abs(z @ bound.W.T) @ bound.M.T + 1e-9).all()


def test_the_bound_on_the_measurement_noise_holds_for_the_true_matrix():
    system = SYSTEMS["lti5-measured"]
    z, y = system.data(0)
    half = measured_noise(z, y, np.full(5, 0.005), system.v_half)
    with_truth = 0.005 + system.v_half + np.abs(system.A) @ system.v_half
    assert (half >= with_truth - 1e-12).all()
    with_estimate = 0.005 + system.v_half + np.abs(least_squares(z, y)[:, :5]) @ system.v_half
    assert (half > with_estimate).all()  # the estimate alone gives no bound


# --- relations between the bounds ---------------------------------------------------------------------------------


def test_the_factored_form_is_the_matrix_zonotope_multiplied_out():
    """M_Σ z from the T·γ generator matrices of lemma 1 has the same support in every direction."""
    truth = PUBLISHED["tzpc_double_integrator"]
    z = np.vstack([truth["X0"], truth["U"]]).T
    y, G = np.array(truth["X1"]).T, np.array(truth["W_gen"])
    rng = np.random.default_rng(0)
    sizes = rng.uniform(0.5, 2.0, (2, len(z)))
    bound = matrix_zonotope(z, y, G, sizes, np.zeros((2, 3)), np.zeros(2))
    pseudo = np.linalg.pinv(z.T)
    matrices = [sizes[j, t] * np.outer(G[:, j], pseudo[t]) for j in range(2) for t in range(len(z))]
    for _ in range(20):
        at, direction = rng.normal(size=3), rng.normal(size=2)
        explicit = sum(abs(direction @ matrix @ at) for matrix in matrices)
        factored = np.abs(direction @ bound.generators) @ bound.magnitudes(at)
        assert factored == pytest.approx(explicit, rel=1e-10)


@pytest.mark.parametrize("name", ["lti5", "double-integrator"])
def test_set_membership_is_never_wider_along_whitened_axes(name):
    z, _ = SYSTEMS[name].data(0)
    bounds = certificates(name)
    along = np.linalg.inv(whitening(z)).T
    inner, outer = bounds["set-membership"].magnitudes(along), bounds["matrix-zonotope"].magnitudes(along)
    assert (inner <= outer + 1e-6).all()


def test_set_membership_shrinks_with_data_and_the_matrix_zonotope_does_not():
    at, noise = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 8.0]), SYSTEMS["lti5"].G.diagonal()
    few, many = (
        {kind: (bound.magnitudes(at) - noise).sum() for kind, bound in certificates("lti5", trajectories=count).items()}
        for count in (10, 80)
    )
    assert many["set-membership"] < 0.5 * few["set-membership"]
    assert many["matrix-zonotope"] > 0.5 * few["matrix-zonotope"]


def too_much_measurement_noise():
    z, y = lti5(v_half=0.5).data(0, trajectories=5)
    measured_noise(z, y, np.full(5, 0.005), np.full(5, 0.5))


def too_small_a_noise_bound():
    z, y = lti5().data(0)
    set_membership(z, y, np.full((5, len(z)), 0.001), np.zeros((5, 6)), np.full(5, 0.001))


def samples_along_one_direction():
    z = np.column_stack([np.linspace(-1, 1, 300), np.zeros(300)])
    set_membership(z, z[:, :1], np.ones((1, 300)), np.zeros((1, 2)), np.ones(1))


def pairs_across_trajectories():
    """Pair the last sample of a trajectory with the first of the next: no matrix is consistent with such data."""
    z, y = lti5().data(0)
    shifted = np.vstack([z[1:, :5], z[:1, :5]])
    assert np.allclose(shifted[:10], y[:10])
    set_membership(z, shifted, np.full((5, len(z)), 0.005), np.zeros((5, 6)), np.full(5, 0.005))


def no_samples():
    Envelopes(np.ones((0, 2)), np.zeros((0, 1)))


REFUSED = {
    too_much_measurement_noise: "γ",
    too_small_a_noise_bound: "too small",
    samples_along_one_direction: "span",
    pairs_across_trajectories: "no matrix",
    no_samples: "no sample",
}


@pytest.mark.parametrize("fit", REFUSED)
def test_data_that_support_no_bound_are_refused(fit):
    with pytest.raises(ErrorBoundError, match=REFUSED[fit]):
        fit()


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.integers(4, 40))
def test_the_outer_form_is_never_narrower(seed, rows):
    rng = np.random.default_rng(seed)
    nz, g = 4, 3
    bound = ErrorBound(
        rng.normal(size=(2, nz)),
        rng.normal(size=(rows, nz)),
        rng.uniform(size=(g, rows)),
        rng.uniform(size=(g, nz)),
        rng.uniform(size=g),
        rng.normal(size=(2, g)),
    )
    basis = rng.normal(size=(nz, nz)) + 3.0 * np.eye(nz)
    outer = bound.outer(basis)
    assert len(outer.W) <= max(nz, 4)
    z = rng.normal(size=(50, nz))
    assert (outer.magnitudes(z) >= bound.magnitudes(z) - 1e-9).all()


def test_the_envelope_bounds_every_sample_and_is_the_smallest():
    rng = np.random.default_rng(1)
    features = np.abs(rng.normal(size=(3000, 3)))
    values = features @ [0.1, 0.0, 0.3] + 0.02 * rng.random(3000)
    (kappa,), (w,) = Envelopes(features, values[:, None]).tightest()
    assert (features @ kappa + w >= values).all()
    rows = np.column_stack([features, np.ones(3000)])
    whole = linprog(np.append(features.mean(0), 1.0), A_ub=-rows, b_ub=-values, bounds=(0, None))
    assert features.mean(0) @ kappa + w == pytest.approx(whole.fun, rel=1e-5)
    (wider,), (more,) = Envelopes(features, values[:, None]).tightest(inflation=1.2)
    assert np.allclose(wider, 1.2 * kappa)
    assert more == pytest.approx(1.2 * w)


@given(st.integers(0, 1000), st.floats(1e-6, 1e3) | st.just(0.0))
@settings(max_examples=30)
def test_the_envelope_bounds_whatever_the_scale(seed, scale):
    rng = np.random.default_rng(seed)
    features = np.abs(rng.normal(size=(200, 2)))
    values = scale * rng.random(200) ** 4
    (kappa,), (w,) = Envelopes(features, values[:, None]).tightest()
    assert (features @ kappa + w >= values).all()
    assert scale or kappa.sum() + w < 1e-6, "the envelope of zeros is zero"


def test_the_residual_certificate_bounds_its_samples():
    rng = np.random.default_rng(2)
    z = rng.normal(size=(500, 3))
    y = z @ rng.normal(size=(3, 2)) + 0.01 * np.sin(5.0 * z[:, :2]) * np.abs(z[:, :1])
    bound = residual(z, y, least_squares(z, y))
    assert (np.abs(y - z @ bound.C.T) <= bound.half_widths(z)).all()


@pytest.mark.parametrize(("value", "low"), [(np.nan, 0.0), (np.inf, 0.0), (1e20, 0.0), (1.0, np.nan)])
def test_a_linear_program_refuses_what_its_solver_would_leave_out(value, low):
    """HiGHS takes NaN for zero, and leaves out a constraint with infinity or a very large number."""
    program = LinearProgram(2, least=0.0)
    with pytest.raises(ErrorBoundError, match="NaN"):
        program.add(np.array([[value, 2.0]]), np.array([low]), np.array([np.inf]))
    with pytest.raises(ErrorBoundError, match="cost"):
        program.minimise(np.array([np.nan, 1.0]))


# --- the facets of a zonotope ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_point_is_inside_exactly_if_no_facet_separates_it(dim, seed):
    rng = np.random.default_rng(seed)
    generators = rng.normal(size=(dim, 5))
    vertices = np.array(list(product((-1.0, 1.0), repeat=5))) @ generators.T
    hull = ConvexHull(vertices).equations  # its outward normals and offsets
    points = rng.normal(size=(50, dim)) * 3.0
    inside = (points @ hull[:, :-1].T + hull[:, -1] <= 0.0).all(1)
    normals = facet_normals(generators)
    by_support = (np.abs(points @ normals.T) <= np.abs(normals @ generators).sum(1)).all(1)
    assert (inside == by_support).all()


def test_more_than_three_dimensions_are_refused():
    with pytest.raises(ValueError, match="3 dimensions"):
        facet_normals(np.eye(4))
