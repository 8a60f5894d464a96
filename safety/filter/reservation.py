"""Space that the robots of one world reserve, for each period and for all time after the plan (docs/method.md §9).

A tube with sets S_0 (where the robot is), S_1, ..., S_N at the ends of its periods keeps the body, in period k, within

    box(S_k ∪ S_{k+1}) ⊕ ball(ρ_k),    ρ_k = body radius + chord deviation (at the end: or stopping distance)

a box along the world's axes. The last box is reserved for all time after the plan, since the robot stands there. With
each period, a reservation loses its first box and keeps its last. The filter decides robots one after the other, each
against the current reservations of all others. So disjoint reservations stay disjoint: a robot without a new plan keeps
its old reservation, and the others were checked against that one. The filter checks the whole reservation, corners
included. A robot without a verified plan gets a reservation that may touch another one. A robot that was decided before
is then decided again. While two reservations touch, the committed plans of these robots do not count as verified.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brakeline.messaging.obstacle import Array, Shapes
from brakeline.messaging.value_equality import ComparedByValue
from brakeline.safety.filter.halfspaces import TOUCHING, roomiest, viewpoints

if TYPE_CHECKING:
    from brakeline.safety.filter.qp import ConstraintRows

ROUNDED = 1e-6  # m: by how much rounding may let disjoint reservations overlap


@dataclass(frozen=True, eq=False)
class Reservation(ComparedByValue):
    """The reservation of one robot from now on."""

    # center, half_width (N, d) [m]: one box for each period, world
    center: Array
    half_width: Array
    radius: Array  # (N,) [m]: added around the box

    @staticmethod
    def of(center: Array, half_width: Array, radius: Array) -> Reservation:
        """Build it from a tube's sets S_0 (now) to S_N as boxes (N+1, d), and radius (N,)."""
        low, high = center - half_width, center + half_width
        low, high = np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])
        return Reservation(0.5 * (low + high), 0.5 * (high - low), radius)

    def may_contain(self, position: Array, error: ArrayLike, body: float) -> bool:
        """Return whether a robot with a measured position (d,) may be in the box of the present period.

        error (d,): largest errors of the position [m]. body: radius of the robot [m], which `radius` contains.
        """
        beyond = np.maximum(np.abs(position - self.center[0]) - self.half_width[0] - error, 0.0)
        return bool(np.linalg.norm(beyond) <= self.radius[0] - body + ROUNDED)

    def later(self) -> Reservation:
        parts = self.center, self.half_width, self.radius
        return Reservation(*(np.concatenate([part[1:], part[-1:]]) for part in parts))


@dataclass(frozen=True, eq=False)
class OtherReservations(ComparedByValue):
    """The reservations of n other robots: their boxes (n·N) as shapes, with the radii as margins."""

    shapes: Shapes
    periods: int

    def __len__(self) -> int:
        return len(self.shapes) // self.periods

    @staticmethod
    def to(others: Sequence[Reservation]) -> OtherReservations | None:
        """Stack reservations; None if there are none."""
        if not others:
            return None
        center, half = (np.concatenate([getattr(p, name) for p in others]) for name in ("center", "half_width"))
        (count, d), periods = center.shape, len(others[0].center)
        axes = np.broadcast_to(np.eye(d), (count, d, d))
        margin = np.concatenate([p.radius for p in others])
        return OtherReservations(Shapes(center, axes, half, np.zeros(count), np.ones((count, d)), margin), periods)

    def nearest(self, point: Array) -> Array:
        """Return the least distance (n,) [m] of each reservation from a point (d,)."""
        return np.asarray((self.shapes.distance(point) - self.shapes.margin).reshape(-1, self.periods).min(axis=1))

    def touch(self, own: Reservation) -> bool:
        """Return whether a robot's own reservation touches one of them in the same period."""
        return bool(self.touched(own).any())

    def touched(self, own: Reservation) -> NDArray[np.bool_]:
        """Return which of them (n,) a robot's own reservation touches in the same period."""
        center, half, radius = (np.tile(part.T, len(self)).T for part in (own.center, own.half_width, own.radius))
        between = np.maximum(np.abs(self.shapes.center - center) - self.shapes.half - half, 0.0)
        overlaps = np.linalg.norm(between, axis=1) - self.shapes.margin - radius < -ROUNDED
        return np.asarray(overlaps.reshape(-1, self.periods).any(axis=1))

    def take(self, chosen: NDArray[np.bool_]) -> OtherReservations:
        """Return the chosen (n,) reservations."""
        return OtherReservations(self.shapes.take(np.repeat(chosen, self.periods)), self.periods)


def reservation_half_spaces(
    near: OtherReservations, start: Array, nominal: Array, keep_off: float, measured: Array
) -> tuple[Array, Array]:
    """Return half-spaces (n, N, d), (n, N) as `half_spaces` does, for boxes that are reserved for one period each.

    For each period, q is any position of the nominal plan up to the end of the period; the plane that leaves both ends
    the most room is taken.
    """
    n, (N, d) = len(near), nominal.shape
    ends, places = viewpoints(start, nominal)
    towards = near.shapes.towards(start + places).reshape(n, N, 2 * N + 1, d)
    gap = np.sqrt(np.einsum("nkqd,nkqd->nkq", towards, towards))
    unit = towards / np.maximum(gap, TOUCHING)[..., None]
    level = np.einsum("nkqd,nkqd->nkq", unit, towards + places)
    level[~(gap > TOUCHING)] = -np.inf  # true for NaN, too
    along = np.maximum(
        np.einsum("nkqd,kd->nkq", unit, ends[:-1]),
        np.einsum("nkqd,kd->nkq", unit, ends[1:]),
    )
    at = np.arange(n)[:, None], np.arange(N), roomiest(level - along)
    margin = near.shapes.margin.reshape(n, N)
    return unit[at], level[at] - np.maximum(keep_off + margin, 0.0) - np.abs(unit[at]) @ measured


class ReservationRows:
    """Builds rows that keep a robot's own reservation inside half-spaces, linear in z and in the magnitudes.

    The support of box(S_k ∪ S_{k+1}) in a direction n is, coordinate by coordinate, that of one of the two ends:

        Σ_i max over e in {k, k+1} of  n_i c_{e,i} + |n_i| h_{e,i}

    with one row for each of the 2^d choices of ends, plus the chord deviation of the period. The rows of the last
    period occur once more with the stopping distance.
    """

    def __init__(self, position: Array, offset: Array, directions: Array) -> None:
        """Position (N, d, nz), offset (N, d), directions (N, d, L): the tube's."""
        N, d, nz = position.shape
        self._position = np.concatenate([np.zeros((1, d, nz)), position])
        self._offset = np.concatenate([np.zeros((1, d)), offset])
        self._directions = np.concatenate([np.zeros((1, d, directions.shape[2])), directions])
        choices = np.array(list(product((0, 1), repeat=d)))  # (2^d, d)
        self.period = np.repeat([*range(N), N - 1], len(choices))  # (R,)
        self._end = self.period[:, None] + np.tile(choices, (N + 1, 1))  # (R, d)
        self._extra = np.eye(N + 1)[np.repeat(np.arange(N + 1), len(choices))]
        self._axis = np.arange(d)

    def rows(self, normals: Array, offsets: Array, turn: Array, widening: float) -> ConstraintRows:
        """Return rows for half-spaces `a·p <= b` relative to the robot's position, a (n, N, d) in the world, b (n, N).

        turn (d, d): rotation from the robot's frame to the world. widening: factor on the sets.
        """
        n = len(normals)
        center = (turn @ self._position)[self._end, self._axis]  # (R, d, nz)
        known = (self._offset @ turn.T)[self._end, self._axis]  # (R, d)
        half = np.abs(turn @ self._directions)[self._end, self._axis]  # (R, d, L)
        normals = normals[:, self.period]  # (n, R, d)
        gradient = np.einsum("nrd,rdz->nrz", normals, center).reshape(n * len(self.period), -1)
        spread = np.einsum("nrd,rdl->nrl", np.abs(normals), half).reshape(len(gradient), -1)
        extra, bound = np.tile(self._extra, (n, 1)), offsets[:, self.period] - np.einsum("nrd,rd->nr", normals, known)
        from brakeline.safety.filter.qp import (
            ConstraintRows,  # here, since a client keeps reservations but needs no solver
        )

        return ConstraintRows(gradient, widening * np.hstack([spread, extra]), bound.ravel())
