"""The reachable tube of a plan, stacked over the horizon once, offline (docs/method.md §2).

The tube is a function of `z = [x_0; input in force; free inputs]` alone. At step i = 1..N the measured position,
relative to where it is now and in the frame of now, lies in

    { P_i z + Σ_l m_l(z) D_{i,l} [-1, 1] },     m(z) = M |W z| + m_0

so a support in any direction is linear in z and in |W z|. The same magnitudes carry two more families of bounds:
the bulge of the path off the chord of each step, and the way travelled after the last input (the stop latch).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Robot
from brakeline.safety.model.error_bounds import ErrorBound

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tube:
    """position (N, d, nz); directions (N, d, L); W (q, nz); M (L+N+1, q); m_0 (L+N+1).

    Magnitudes: of the L generators, of the N bulges, and of the latch. more (N, r, nz), more_directions (N, r, L): the
    same of other predicted coordinates, where a limit or a further disc of the body needs them.
    """

    position: Array
    directions: Array
    W: Array
    M: Array
    m_0: Array
    more: Array
    more_directions: Array

    @property
    def horizon(self) -> int:
        return int(self.position.shape[0])

    @property
    def generators(self) -> int:
        return int(self.directions.shape[2])

    def centers(self, z: Array) -> Array:
        """(N, d) for one z (nz,)."""
        return np.asarray(self.position @ z)

    def magnitudes(self, z: Array) -> Array:
        """For regressors z (..., nz): (..., L+N+1)."""
        return np.asarray(np.abs(z @ self.W.T) @ self.M.T + self.m_0)

    def half_widths(self, z: Array) -> Array:
        """Interval hulls of the sets (N, d), the bulge or the latch not included."""
        return np.asarray(np.abs(self.directions) @ self.magnitudes(z)[: self.generators])


def stack_direct(
    steps: Sequence[ErrorBound],
    position_dim: int,
    chord_deviations: ErrorBound,
    stopping_distance: ErrorBound,
    more: Sequence[int] = (),
) -> Tube:
    """One predictor per horizon step: step i has generators of its own and nothing compounds.

    steps: certificate i predicts the displacement after i+1 periods from z. bulges (N rows), latch (1 row) likewise.
    more: further predicted coordinates to keep.
    """
    d, count = position_dim, [c.generators.shape[1] for c in steps]
    kept = [*range(d), *more]
    directions = np.zeros((len(steps), len(kept), sum(count)))
    for i, step in enumerate(steps):
        at = sum(count[:i])
        directions[i, :, at : at + count[i]] = step.generators[kept]
    useful = np.abs(directions).sum((0, 1)) > 0.0  # those of the velocity coordinates never touch the position
    atoms = [_atoms(c) for c in (*steps, chord_deviations, stopping_distance)]
    W = np.vstack([w for w, _, _ in atoms])
    M = _block_diagonal([m for _, m, _ in atoms])
    rows = np.concatenate([useful, np.ones(len(steps) + 1, dtype=bool)])
    m_0 = np.concatenate([m0 for _, _, m0 in atoms])
    W, M = _merged(W, M[rows])
    centers, directions = np.stack([c.C[kept] for c in steps]), directions[:, :, useful]
    return Tube(centers[:, :d], directions[:, :d], W, M, m_0[rows], centers[:, d:], directions[:, d:])


@dataclass(frozen=True)
class RecursionMaps:
    """How regressors follow from states: z_k = [E y_k; u_{k-1}; u_k], y_k (n) with the position first.

    E: indices of y in the regressor; relative: the first so many coordinates are predicted as displacement;
    inputs: m; plan: (N·m, F·m), `plan = S free`;
    first: (n, nz), y_0 from z = [x_0; u_prev; free] with the position at zero; nz = first.shape[1].
    """

    E: tuple[int, ...]
    relative: int
    inputs: int
    plan: Array
    first: Array

    def previous(self) -> Array:
        """(m, nz): the input in force, from z."""
        nz, m = self.first.shape[1], self.inputs
        pick = np.zeros((m, nz))
        free = self.plan.shape[1]
        pick[:, nz - free - m : nz - free] = np.eye(m)
        return pick

    def input(self, k: int) -> Array:
        """(m, nz): the plan's k-th input, from z."""
        nz, m = self.first.shape[1], self.inputs
        pick = np.zeros((m, nz))
        pick[:, nz - self.plan.shape[1] :] = self.plan[k * m : (k + 1) * m]
        return pick


def recursion_maps(robot: Robot, plans: bool = True) -> RecursionMaps:
    """y = (position, heading, speeds ...), all relative to the frame of now; z ends in a plan's chosen inputs, or in
    all of its inputs, one by one."""
    reg = list(robot.regressor)
    S = robot.plan_matrix() if plans else np.eye(robot.horizon * robot.action_dim)
    nz = robot.regressor_dim + S.shape[1]
    first = np.zeros((robot.state_dim, nz))
    first[reg, np.arange(len(reg))] = 1.0
    E = tuple(range(robot.position_dim, robot.state_dim))
    return RecursionMaps(E, robot.position_dim, robot.action_dim, S, first)


def stack_recursive(
    steps: Sequence[ErrorBound],
    how: RecursionMaps,
    position_dim: int,
    chord_deviations: ErrorBound | None = None,
    stopping_distance: ErrorBound | None = None,
    initial: Array | None = None,
    more: Sequence[int] = (),
) -> Tube:
    """The paper's recursion (lemma 2): step k maps z_k to y_{k+1}, `y+ = A y + B [u_prev; u] + noise`.

    A generator made at step k has length m_{k,j} = w + t + r + Σ K m: t at the centre, r over the generators of the
    initial set (n, g), K over those made before; K is strictly lower triangular, so `m = (I - K)⁻¹ (w + t + r)`.
    """
    n, nz = how.first.shape
    y, before = how.first, how.previous()
    made = np.zeros((n, 0)) if initial is None else initial  # all generators so far, propagated to step k
    start = made.shape[1]
    regress, kept = list(how.E), [*range(position_dim), *more]
    centers, spreads, atoms, K_rows = [], [], [], []
    for k, step in enumerate(steps):
        z_k = np.vstack([y[regress], before, how.input(k)])
        W, M, w = _atoms(step)
        K_rows.append(M @ np.abs(W[:, : len(regress)] @ made[regress]))
        atoms.append((W @ z_k, M, w))
        carry = np.diag(np.arange(n) < how.relative).astype(float)
        A = carry.copy()
        A[:, regress] += step.C[:, : len(regress)]
        y = carry @ y + step.C @ z_k
        made = np.hstack([A @ made, step.generators])
        before = how.input(k)
        centers.append(y[kept])
        spreads.append(made[kept])
    total = made.shape[1]
    K = np.zeros((total - start, total))
    at = 0
    for row in K_rows:
        K[at : at + len(row), : row.shape[1]] = row
        at += len(row)
    mix = np.linalg.inv(np.eye(total - start) - K[:, start:])
    W = np.vstack([a for a, _, _ in atoms])
    M = mix @ _block_diagonal([m for _, m, _ in atoms])
    m_0 = mix @ (np.concatenate([w for _, _, w in atoms]) + K[:, :start].sum(1))
    directions = np.zeros((len(steps), len(kept), total))
    for i, spread in enumerate(spreads):
        directions[i, :, : spread.shape[1]] = spread
    M = np.vstack([np.zeros((start, M.shape[1])), M])
    m_0 = np.concatenate([np.ones(start), m_0])
    extra = [_atoms(c) for c in (chord_deviations, stopping_distance) if c is not None]
    if not extra:
        extra = [(np.zeros((0, nz)), np.zeros((len(steps) + 1, 0)), np.zeros(len(steps) + 1))]
    W = np.vstack([W, *(w for w, _, _ in extra)])
    M = _block_diagonal([M, *(m for _, m, _ in extra)])
    W, M = _merged(W, M)
    m_0, stack_rows, d = np.concatenate([m_0, *(m0 for _, _, m0 in extra)]), np.stack(centers), position_dim
    return Tube(stack_rows[:, :d], directions[:, :d], W, M, m_0, stack_rows[:, d:], directions[:, d:])


def _atoms(step: ErrorBound) -> tuple[Array, Array, Array]:
    """A certificate's κ as further rows of W: (W, M, w)."""
    W = np.vstack([step.W, np.eye(step.kappa.shape[1])])
    return W, np.hstack([step.M, step.kappa]), step.w


def _merged(W: Array, M: Array) -> tuple[Array, Array]:
    """The same sums with parallel rows of W as one and rows that bound nothing left out."""
    length = np.linalg.norm(W, axis=1)
    length[M.max(0, initial=0.0) <= 0.0] = 0.0
    keep = length > 0.0
    W, M, length = W[keep], M[:, keep], length[keep]
    unit = W / length[:, None]
    unit *= np.sign(unit[np.arange(len(W)), np.abs(unit).argmax(1)])[:, None]
    _, first, inverse = np.unique(np.round(unit, 12), axis=0, return_index=True, return_inverse=True)
    merged = np.zeros((len(M), len(first)))
    np.add.at(merged.T, inverse.ravel(), (M * length).T)
    return unit[first], merged


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    total = np.zeros((sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)))
    r = c = 0
    for block in blocks:
        total[r : r + block.shape[0], c : c + block.shape[1]] = block
        r, c = r + block.shape[0], c + block.shape[1]
    return total
