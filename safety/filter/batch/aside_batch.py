"""Turn the blocked robots of a batch aside: `turning_aside` for many robots (docs/method.md §4); the batch is last."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from brakeline.safety.filter.batch.constraint_batch import taken
from brakeline.safety.filter.batch.obstacle_arrays import Array
from brakeline.safety.filter.batch.qp_batch import ROUNDING
from brakeline.safety.filter.batch.search_batch import CandidateBatch, LaneBatch, SearchBatch
from brakeline.safety.filter.halfspaces import rows_per_obstacle
from brakeline.safety.filter.turning_aside import BEYOND_EDGE, is_blocked, may_turn_aside, way_ahead

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter

NEARLY = 1e-5  # of an input: as blocked as this may be, the single path decides
MOST_EDGES = 64  # of sectors; a lane with more of them in a row is left to the single path


class AsideBatch:
    """Searches for plans that turn blocked robots aside, with the matrices of a search."""

    def __init__(self, safety: Filter, search: SearchBatch, constant: Any, xp: Any) -> None:
        robot = safety.robot
        self._xp, self._search, self._robot, self._period = xp, search, robot, robot.period
        self._clearance = safety.clearance_margin
        self._speed = robot.translates.index(True) if may_turn_aside(robot) else None
        if self._speed is not None:
            self._way = way_ahead(robot)
            self._translates = constant([[float(translates)] for translates in robot.translates]) > 0.5

    def turn(self, lanes: LaneBatch, candidates: CandidateBatch, asks: Array) -> None:
        """Replace the adjusted plans of blocked robots by plans that turn them aside, where such plans are verified.

        asks (B,): the request lets the filter do so. A lane whose result rounding could change is no longer adjusted:
        it is left to the single path.
        """
        xp, speed = self._xp, self._speed
        if speed is None:
            return
        speeds = lanes.proposal[speed], candidates.z[self._search.known + speed]
        maybe, surely = (
            asks & candidates.adjusted & is_blocked(self._robot, *speeds, near) for near in (NEARLY, -NEARLY)
        )
        candidates.adjusted &= surely | ~maybe
        blocked = xp.nonzero(surely)[0]
        if not blocked.shape[0]:
            return
        part = taken(xp, lanes, blocked)
        turn, unsure = self._free_turn(part)
        candidates.adjusted[blocked[unsure]] = False
        aside = xp.nonzero((turn != 0.0) & xp.isfinite(turn) & ~unsure)[0]
        if aside.shape[0]:
            self._search_aside(taken(xp, part, aside), xp.take(turn, aside, axis=0), blocked[aside], candidates)

    def _search_aside(self, lanes: LaneBatch, turn: Array, to: Array, candidates: CandidateBatch) -> None:
        """Search near the proposed speed with these turns (B,) [rad]; write the results to the lanes `to`."""
        xp, search = self._xp, self._search
        wanted = xp.where(self._translates, lanes.proposal, turn[None] / self._period)
        lanes = replace(lanes, proposal=search.limited(wanted, lanes.z_0[search.known - wanted.shape[0] :]))
        proposed = search.propose(lanes)
        rest = xp.nonzero(~proposed.allowed & ~proposed.unsure)[0]
        z, margin = proposed.plan.z, proposed.margin
        verified, undecided = xp.asarray(proposed.allowed, copy=True), xp.asarray(proposed.unsure, copy=True)
        if rest.shape[0]:
            part = search.adjust(taken(xp, lanes, rest), taken(xp, proposed, rest))
            z[:, rest], margin[rest] = part.z, part.margin
            verified[rest] = part.allowed | part.adjusted
            undecided[rest] = ~(part.allowed | part.adjusted | part.hopeless)
            candidates.steps[to[rest]] = candidates.steps[to[rest]] + part.steps
        candidates.adjusted[to[undecided]] = False
        here = to[verified]
        candidates.z[:, here], candidates.margin[here] = z[:, verified], margin[verified]
        candidates.turned[here] = xp.astype(xp.where(turn > 0.0, 1, -1), xp.int64)[verified]

    def _free_turn(self, lanes: LaneBatch) -> tuple[Array, Array]:
        """Return the smallest turns (B,) [rad] to directions in which robots can drive on; and unsure lanes (B,)."""
        xp = self._xp
        if not lanes.scene.near.rho.shape[0]:
            nothing = xp.zeros_like(lanes.scene.far, dtype=xp.float64)
            return nothing, xp.zeros_like(lanes.scene.far)
        middles, half_angles = self._blocked_sectors(lanes)
        left, close_left = self._edge(middles, half_angles)
        right, close_right = self._edge(-middles, half_angles)
        further = left - right - BEYOND_EDGE
        unsure = close_left | close_right | (xp.abs(further) < ROUNDING)
        return xp.where(further <= 0.0, left, -right), unsure

    def _blocked_sectors(self, lanes: LaneBatch) -> tuple[Array, Array]:
        """Return the middles and half-angles (R, B) [rad] of the sectors: `turning_aside.blocked_sectors`."""
        xp, constraints = self._xp, self._search.constraints
        plan = constraints.around(lanes.scene, self._search.staying(lanes))
        K, B = lanes.scene.near.rho.shape
        slack = xp.reshape(plan.slack, (len(plan.planes), rows_per_obstacle(constraints.N), K, B))
        room = xp.reshape(xp.min(slack, axis=1), (-1, B)) - self._clearance
        ahead = xp.where(lanes.proposal[self._speed] < 0.0, math.pi, 0.0)
        towards = [xp.atan2(planes.turned[1][0], planes.turned[0][0]) for planes in plan.planes]
        half_angles = xp.acos(xp.clip(room / self._way, 0.0, 1.0))
        used = xp.concat([lanes.scene.near.used] * len(plan.planes))
        return xp.concat(towards) - ahead, xp.where(used, half_angles, -1.0)  # an empty slot blocks nothing

    def _edge(self, middles: Array, half_angles: Array) -> tuple[Array, Array]:
        """Return the smallest angles (B,) >= 0 [rad] outside all sectors, and unsure lanes: `turning_aside._edge`."""
        xp = self._xp
        angle, unsure = xp.zeros_like(middles[0]), xp.zeros_like(middles[0], dtype=xp.bool)
        for _ in range(MOST_EDGES):
            off = xp.remainder(middles - angle + math.pi, math.tau) - math.pi
            left = half_angles - xp.abs(off)
            unsure |= xp.any(xp.abs(left) < ROUNDING, axis=0) & (angle < math.tau)
            beyond = xp.max(xp.where(left > 0.0, off + half_angles, -xp.inf), axis=0)
            goes_on = (beyond > -xp.inf) & (angle < math.tau)
            if not bool(xp.any(goes_on)):
                return xp.where(angle < math.tau, angle, xp.inf), unsure
            angle = xp.where(goes_on, angle + beyond + BEYOND_EDGE, angle)
        return angle, unsure | goes_on
