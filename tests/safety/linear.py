"""Linear systems with known noise: data from a seeded generator, and their tubes through the code under test."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brakeline.safety.filter.reachable_tube import RecursionMaps, Tube, stack_recursive
from brakeline.safety.model.error_bounds import ErrorBound

PUBLISHED = json.loads((Path(__file__).parents[1] / "truth" / "published.json").read_text())


@dataclass(frozen=True)
class Linear:
    """x+ = A x + B u + G b, b in the unit box; measured y = x + v, |v| <= v_half."""

    A: np.ndarray
    B: np.ndarray
    G: np.ndarray
    center: np.ndarray  # of the inputs
    swing: np.ndarray
    v_half: np.ndarray

    def data(self, seed, trajectories=40, periods=12):
        """(z, y): regressors [y_t; u_t] (T, n+m) and next measurements (T, n), paired within trajectories only."""
        rng = np.random.default_rng(seed)
        n = len(self.A)
        z, y = [], []
        for _ in range(trajectories):
            x = rng.normal(size=n)
            measured = x + rng.uniform(-self.v_half, self.v_half)
            for _ in range(periods):
                u = self.center + rng.uniform(-self.swing, self.swing)
                x = self.A @ x + self.B @ u + self.G @ rng.uniform(-1, 1, self.G.shape[1])
                z.append(np.concatenate([measured, u]))
                measured = x + rng.uniform(-self.v_half, self.v_half)
                y.append(measured)
        return np.array(z), np.array(y)

    def tube(self, certificate: ErrorBound, horizon: int) -> Tube:
        """Of `z = [y_0; input in force; u_0 .. u_{N-1}]`; the input in force plays no part."""
        n, m = self.B.shape
        first = np.hstack([np.eye(n), np.zeros((n, m + horizon * m))])
        how = RecursionMaps(tuple(range(n)), 0, m, np.eye(horizon * m), first)
        return stack_recursive([with_previous_input(certificate, n, m)] * horizon, how, n)

    def rollouts(self, rng, y_0, plan, count, worst):
        """Measured states (count, N, n) from the measured y_0 under one plan (N, m), random or vertex noise."""
        n, horizon = len(y_0), len(plan)

        def unit(*shape):
            b = rng.uniform(-1, 1, shape)
            return np.sign(b) if worst else b

        x = y_0 - self.v_half * unit(count, n)
        b = unit(count, horizon, self.G.shape[1])
        if worst:  # half of them push one direction as far as it goes
            direction = rng.normal(size=n)
            for k in range(horizon):
                pushed = np.sign(direction @ np.linalg.matrix_power(self.A, horizon - 1 - k) @ self.G)
                b[: count // 2, k] = pushed
        states = []
        for k in range(horizon):
            x = x @ self.A.T + plan[k] @ self.B.T + b[:, k] @ self.G.T
            states.append(x + self.v_half * unit(count, n))
        return np.stack(states, axis=1)


def with_previous_input(c: ErrorBound, n: int, m: int) -> ErrorBound:
    """The certificate with columns of zeros for the input in force, after the n states."""

    def wider(a):
        return np.hstack([a[:, :n], np.zeros((len(a), m)), a[:, n:]])

    return ErrorBound(wider(c.C), wider(c.W), c.M, wider(c.kappa), c.w, c.generators)


def lti5(v_half=0.0) -> Linear:
    truth = PUBLISHED["lti5_zoh"]
    return Linear(
        np.array(truth["Ad"]),
        np.array(truth["Bd"])[:, None],
        truth["w_half"] * np.eye(5),
        np.array([8.0]),
        np.array([10.0]),
        np.full(5, v_half),
    )


def double_integrator() -> Linear:
    truth = PUBLISHED["tzpc_double_integrator"]
    A, B, G = (np.array(truth[name]) for name in ("A", "B", "W_gen"))
    return Linear(A, B, G, np.zeros(1), np.ones(1), np.zeros(2))


def count_outside(tube: Tube, z, states, directions) -> int:
    """How many of the states (count, N, n) lie outside, by the tube's supports written out here."""
    sizes = np.abs(tube.W @ z) @ tube.M.T + tube.m_0
    bad = np.zeros(len(states), dtype=bool)
    for k in range(states.shape[1]):
        spread = np.abs(directions @ tube.directions[k]) @ sizes[: tube.generators]
        away = np.abs((states[:, k] - tube.position[k] @ z) @ directions.T)
        bad |= (away > spread + 1e-12).any(1)
    return int(bad.sum())
