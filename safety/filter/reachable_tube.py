"""The reachable tube of a plan, with its matrices stacked over the horizon when the model set is loaded.

There are three ways to stack error bounds (docs/method.md §2, §13): `stack_direct` has a predictor for each number of
periods, `stack_recursive` is the recursion of Lemma 2, and `stack_rollout` rolls one learned period out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.error_bounds import ErrorBound

if TYPE_CHECKING:
    from brakeline.safety.model.one_step import OneStep, Predictor


@dataclass(frozen=True)
class Tube:
    """The sets that contain the measured position at the end of each period i = 1..N, for regressors z.

        p_i ∈ p_0 + R(θ_0) ( P_i z + c_i + Σ_l m_l(z) D_{i,l} [-1, 1] ),     m(z) = M |W z| + m_0

    so the support in a direction is affine in z and |W z| (docs/method.md §2, equation 2).
    """

    position: Array  # (N, d, nz): P
    directions: Array  # (N, d, L): D
    W: Array  # (q, nz): W
    # M (L+N+1, q), m_0 (L+N+1,): rows for the L generators, then the N chord deviations β_k, then the stopping distance
    # σ
    M: Array
    m_0: Array
    # more (N, r, nz), more_directions (N, r, L), more_offset (N, r): the same for other predicted coordinates, which a
    # limit or a further disc of the body needs
    more: Array
    more_directions: Array
    offset: Array  # (N, d): c, zero for a linear predictor
    more_offset: Array
    # (n,): what a predictor that is not linear adds to the prediction of all coordinates after one period
    first: Array = field(default_factory=lambda: np.zeros(0))
    # (N,): factors that `directions` and `more_directions` hold already, or none
    stretch: Array = field(default_factory=lambda: np.zeros(0))

    def at(self, z: Array) -> Tube:
        """Return a tube that equals this one for regressors z (nz,). Its matrices are those of a linear predictor."""
        return self

    def affine(self, z: Array) -> Tube:
        """Return the tube that `at` gave for regressors z (nz,), with centers that are affine everywhere."""
        return self

    @property
    def horizon(self) -> int:
        return int(self.position.shape[0])

    @property
    def generators(self) -> int:
        return int(self.directions.shape[2])

    def centers(self, z: Array) -> Array:
        """Return the centers P_i z + c_i (N, d) for one z (nz,)."""
        return np.asarray(self.position @ z + self.offset)

    def outputs(self, z: Array) -> tuple[Array, Array]:
        """Return the centers (T, N, d), and those of the other predicted coordinates (T, N, r), for all z (T, nz)."""
        return np.moveaxis(self.position @ z.T, -1, 0), np.moveaxis(self.more @ z.T, -1, 0)

    def magnitudes(self, z: Array) -> Array:
        """Return m(z) (..., L+N+1) for regressors z (..., nz)."""
        return np.asarray(np.abs(z @ self.W.T) @ self.M.T + self.m_0)

    def half_widths(self, z: Array) -> Array:
        """Return half-widths (N, d) of the sets' interval hulls, without chord deviation and stopping distance."""
        return np.asarray(np.abs(self.directions) @ self.magnitudes(z)[: self.generators])

    def more_half_widths(self, z: Array) -> Array:
        """Return half-widths (N, r) of the other predicted coordinates."""
        return np.asarray(np.abs(self.more_directions) @ self.magnitudes(z)[: self.generators])


def stack_direct(
    steps: Sequence[ErrorBound],
    position_dim: int,
    chord_deviations: ErrorBound,
    stopping_distance: ErrorBound,
    more: Sequence[int] = (),
) -> Tube:
    """Stack one error bound for each number of periods: each has its own generators, and no error accumulates.

    Args:
        steps: bound i is about the displacement after i+1 periods, from z.
        chord_deviations: N rows. stopping_distance: one row.
        more: further predicted coordinates that the tube keeps.
    """
    d, count = position_dim, [c.generators.shape[1] for c in steps]
    coordinates = [*range(d), *more]
    directions = np.zeros((len(steps), len(coordinates), sum(count)))
    for i, step in enumerate(steps):
        at = sum(count[:i])
        directions[i, :, at : at + count[i]] = step.generators[coordinates]
    useful = np.abs(directions).sum((0, 1)) > 0.0  # generators of velocities do not move the position
    atoms = [_atoms(c) for c in (*steps, chord_deviations, stopping_distance)]
    W = np.vstack([w for w, _, _ in atoms])
    M = _block_diagonal([m for _, m, _ in atoms])
    rows = np.concatenate([useful, np.ones(len(steps) + 1, dtype=bool)])
    m_0 = np.concatenate([m0 for _, _, m0 in atoms])
    W, M = _merged(W, M[rows])
    centers, directions = np.stack([c.C[coordinates] for c in steps]), directions[:, :, useful]
    return _tube(centers, directions, W, M, m_0[rows], d)


def _tube(centers: Array, directions: Array, W: Array, M: Array, m_0: Array, d: int) -> Tube:
    """Return a tube with linear centers (N, d + r, nz) and directions (N, d + r, L), position first."""
    still = np.zeros(centers.shape[:2])
    of_position = np.ascontiguousarray(centers[:, :d]), np.ascontiguousarray(directions[:, :d])
    return Tube(*of_position, W, M, m_0, centers[:, d:], directions[:, d:], still[:, :d], still[:, d:])


@dataclass(frozen=True)
class RolloutTube(Tube):
    """A tube around the rollout of one learned period (docs/method.md §13). Its own linear centers are zero."""

    # robot, one_step: the predictor, and the robot that it is about
    robot: Robot = field(kw_only=True)
    one_step: OneStep = field(kw_only=True)
    # (r + m + N·m, nz): the map from z to the regressors of a window, which hold all inputs
    inputs_of: Array = field(kw_only=True)
    further: tuple[int, ...] = field(kw_only=True)  # (r,): indices of the coordinates in `more`

    @cached_property
    def _further(self) -> NDArray[np.int64]:
        return np.array(self.further, dtype=np.int64)

    @cached_property
    def _sets_around(self) -> Callable[[Array], tuple[Array, Array, Array, Array, Array, Array]]:
        from brakeline.safety.filter.kernels import rollout_kernels

        sets = np.ascontiguousarray(self.directions), np.ascontiguousarray(self.more_directions)
        predictor = self.one_step.rollout_arguments(self.robot)
        return partial(rollout_kernels.sets_around, *predictor, self.inputs_of, self._further, *sets)

    @cached_property
    def _arguments(self) -> Predictor:
        return self.one_step.arguments(self.robot)

    def at(self, z: Array) -> Tube:
        """Return the sets around the rollout from z."""
        centers, wide, more, more_wide, first, stretch = self._sets_around(z)
        still, more_still = self._still
        sets = still, wide, self.W, self.M, self.m_0, more_still, more_wide, centers, more, first, stretch
        return TubeAround(*sets, rollout=self)

    @cached_property
    def _still(self) -> tuple[Array, Array]:
        """Maps of no regressors, for positions and further coordinates."""
        return np.zeros((*self.position.shape[:2], 0)), np.zeros((*self.more.shape[:2], 0))

    def maps(self, z: Array) -> tuple[Array, Array, Array, Array]:
        """Return gradient and offset of the centers, and of the other coordinates: the rollout, linearised at z."""
        from brakeline.safety.filter.kernels import rollout_kernels

        return rollout_kernels.affine(self._arguments, z, self.inputs_of, self._further)

    def centers(self, z: Array) -> Array:
        """Return the predicted positions (N, d) for one z (nz,), in the frame of the start."""
        return np.asarray(self.outputs(z[None])[0][0])

    def outputs(self, z: Array) -> tuple[Array, Array]:
        outputs = self.one_step.rollouts(self.robot, z @ self.inputs_of.T)
        return outputs[..., : self.position.shape[1]], outputs[..., list(self.further)]


@dataclass(frozen=True)
class TubeAround(Tube):
    """The sets around one rollout. Its centers are constant: `position` and `more` map no regressors."""

    rollout: RolloutTube = field(kw_only=True)

    def centers(self, z: Array) -> Array:
        return self.offset

    def affine(self, z: Array) -> Tube:
        position, offset, more, more_offset = self.rollout.maps(z)
        sets = position, self.directions, self.W, self.M, self.m_0, more, self.more_directions, offset, more_offset
        return Tube(*sets, self.first, self.stretch)


def stack_rollout(linear: Tube, robot: Robot, one_step: OneStep, inputs_of: Array, more: Sequence[int]) -> RolloutTube:
    """Return the tube around a rollout, with the sets of a tube that was stacked from zero predictors."""
    fields = {name: getattr(linear, name) for name in Tube.__dataclass_fields__}
    whole = np.ascontiguousarray(inputs_of, dtype=float)
    return RolloutTube(**fields, robot=robot, one_step=one_step, inputs_of=whole, further=tuple(more))


@dataclass(frozen=True)
class RecursionMaps:
    """The linear maps of the recursion: z_k = [E y_k; u_{k-1}; u_k], with the state y_k (n,), position first."""

    E: tuple[int, ...]  # indices of the coordinates of y in the regressor
    relative: int  # number of leading coordinates that are predicted as displacements
    inputs: int  # m
    plan: Array  # (N·m, F·m): S, from free inputs to all inputs
    first: Array  # (n, nz): y_0 from z = [x_0; u_{-1}; f], with the position at zero

    def input(self, k: int) -> Array:
        """Return the map (m, nz) from z to input k of the plan, or to the input in force for k = -1."""
        m, known = self.inputs, self.first.shape[1] - self.plan.shape[1]
        pick = np.zeros((m, self.first.shape[1]))
        if k < 0:
            pick[:, known - m : known] = np.eye(m)
        else:
            pick[:, known:] = self.plan[k * m : (k + 1) * m]
        return pick


def recursion_maps(robot: Robot, plans: bool = True) -> RecursionMaps:
    """Return the maps for a robot. plans: z ends in the free inputs of a plan; otherwise in all N inputs."""
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
    more: Sequence[int] = (),
) -> Tube:
    """Stack the paper's recursion (Lemma 2): step k maps z_k to y_{k+1} = A y_k + B [u_{k-1}; u_k] + error.

    The measured state is the start. The lengths of the generators solve m = w + t(z) + K m, with K strictly lower
    triangular, so

        m = (I - K)⁻¹ (w + t(z))                                                       (docs/method.md §2)
    """
    n, nz = how.first.shape
    y, before = how.first, how.input(-1)
    generators = np.zeros((n, 0))  # all generators so far, propagated to step k
    regress, coordinates = list(how.E), [*range(position_dim), *more]
    centers, spreads, atoms, K_rows = [], [], [], []
    for k, step in enumerate(steps):
        z_k = np.vstack([y[regress], before, how.input(k)])
        W, M, w = _atoms(step)
        K_rows.append(M @ np.abs(W[:, : len(regress)] @ generators[regress]))
        atoms.append((W @ z_k, M, w))
        carry = np.diag(np.arange(n) < how.relative).astype(float)
        A = carry.copy()
        A[:, regress] += step.C[:, : len(regress)]
        y = carry @ y + step.C @ z_k
        generators = np.hstack([A @ generators, step.generators])
        before = how.input(k)
        centers.append(y[coordinates])
        spreads.append(generators[coordinates])
    W, M, m_0 = _generator_lengths(atoms, K_rows)
    directions = np.zeros((len(steps), len(coordinates), len(m_0)))
    for i, spread in enumerate(spreads):
        directions[i, :, : spread.shape[1]] = spread
    extra = [_atoms(c) for c in (chord_deviations, stopping_distance) if c is not None]
    if not extra:
        extra = [(np.zeros((0, nz)), np.zeros((len(steps) + 1, 0)), np.zeros(len(steps) + 1))]
    W = np.vstack([W, *(w for w, _, _ in extra)])
    M = _block_diagonal([M, *(m for _, m, _ in extra)])
    W, M = _merged(W, M)
    return _tube(np.stack(centers), directions, W, M, np.concatenate([m_0, *(m0 for _, _, m0 in extra)]), position_dim)


def _generator_lengths(
    atoms: Sequence[tuple[Array, Array, Array]], K_rows: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Solve m = w + t(z) + K m for (W, M, m_0), so that m = M |W z| + m_0.

    atoms: `_atoms` of each step; K_rows: the rows of K by step.
    """
    w = np.concatenate([w for _, _, w in atoms])
    K, at = np.zeros((len(w), len(w))), 0
    for row in K_rows:
        K[at : at + len(row), : row.shape[1]] = row
        at += len(row)
    inverse = np.linalg.inv(np.eye(len(w)) - K)
    return np.vstack([W for W, _, _ in atoms]), inverse @ _block_diagonal([M for _, M, _ in atoms]), inverse @ w


def _atoms(step: ErrorBound) -> tuple[Array, Array, Array]:
    """Return (W, M, w) of an error bound, with κ as further rows of W."""
    W = np.vstack([step.W, np.eye(step.kappa.shape[1])])
    return W, np.hstack([step.M, step.kappa]), step.w


def _merged(W: Array, M: Array) -> tuple[Array, Array]:
    """Merge parallel rows of W, and leave out rows without effect; the sums M |W z| stay the same."""
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
