"""Turn a blocked robot aside instead of stopping it before an obstacle (docs/method.md §4).

The input closest to a proposal that drives at an obstacle stops the robot and turns it as proposed. A policy without
memory then sees nothing new and proposes the same again, or turns to and fro: the robot is safe, and stuck. If a
request says `turn_aside`, the filter turns such a robot towards the nearest direction in which it can drive on, and
searches for the input that is closest to the proposed speed with that turn. The plan is verified as any other.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.filter.halfspaces import rows_per_obstacle
from brakeline.safety.filter.plan_search import DecisionRecord, PlanCandidate, PlanSearch
from brakeline.safety.filter.request import ADJUSTED

BLOCKED = 0.3  # of the proposed speed: a robot that may drive at least as fast is not blocked
SLOWEST = 0.08  # of the speed's range: a robot that is proposed to drive slower means to stand
PERIODS = 2  # at the highest speed, for which the new direction must be free
BEYOND_EDGE = 1e-6  # rad; the edge of a sector itself is blocked


def may_turn_aside(robot: Robot) -> bool:
    """Return whether a robot has a speed that moves it along its heading, and a turn rate that does not move it."""
    return robot.heading is not None and sorted(robot.translates) == [False, True]


def find_plan(search: PlanSearch, committed: Array, turn_aside: bool) -> PlanCandidate | None:
    """Return the first verified plan of a search, or None.

    Args:
        search: the search near the proposal.
        committed: free inputs of the committed plan.
        turn_aside: turn the robot aside if that plan leaves it blocked, and if a plan that does so is verified.
    """
    robot, candidate = search.safety.robot, search.candidate(committed)
    if candidate is None or candidate.kind != ADJUSTED or not (turn_aside and may_turn_aside(robot)):
        return candidate
    speed = robot.translates.index(True)
    if not is_blocked(robot, search.proposal[speed], candidate.z[len(search.z_0) + speed]):
        return candidate
    return _turned_aside(search, candidate, committed)


def _turned_aside(search: PlanSearch, stopped: PlanCandidate, committed: Array) -> PlanCandidate:
    """Return a verified plan that turns a blocked robot aside; without one, `stopped`."""
    robot = search.safety.robot
    speed = robot.translates.index(True)
    turn = free_turn(*blocked_sectors(search, backwards=bool(search.proposal[speed] < 0.0)))
    if turn == 0.0 or not math.isfinite(turn):
        return stopped
    wanted = np.where(robot.translates, search.proposal, turn / robot.period)
    proposal, record = search.safety.inputs.limited(wanted, search.before), DecisionRecord(search.record.started)
    aside = PlanSearch(search.safety, search.local_map, search.z_0, proposal, record).candidate(committed)
    search.record.solve_ns += record.solve_ns
    search.record.iterations += record.iterations
    if aside is None:
        return stopped
    search.record.reason += turns_aside_to(turn)
    aside.kind, aside.for_clearance = ADJUSTED, stopped.for_clearance
    return aside


def turns_aside_to(turn: float) -> str:
    """Return what a reason adds for a turn: positive to the left."""
    return f"; the robot turns aside to the {'left' if turn > 0.0 else 'right'}"


def is_blocked(robot: Robot, proposed: Any, executed: Any, tolerance: float = 0.0) -> Any:
    """Return whether a robot is blocked that drives with the speed `executed` instead of `proposed`.

    The speeds are numbers, or arrays of any namespace. A robot that is blocked to within `tolerance` counts, too.
    """
    speed = robot.translates.index(True)
    span = robot.action_high[speed] - robot.action_low[speed]
    moves = abs(proposed) >= SLOWEST * span - tolerance
    return moves & (abs(executed) <= BLOCKED * abs(proposed) + tolerance)


def way_ahead(robot: Robot) -> float:
    """Return the way [m] of `PERIODS` at the highest speed."""
    speed = robot.translates.index(True)
    return float(PERIODS * robot.period * max(abs(bound[speed]) for bound in robot.bounds))


def blocked_sectors(search: PlanSearch, backwards: bool = False) -> tuple[Array, Array]:
    """Return the sectors in which a standing robot cannot drive on: their middles (n,) and half-angles (n,) [rad].

    The middles are relative to the direction of motion. An obstacle at the distance r, beyond all margins, blocks the
    directions in which the robot would come nearer by more than r on its next `PERIODS`.
    """
    safety, at = search.safety, search.standing
    per_obstacle, row, rooms = rows_per_obstacle(safety.robot.horizon), 0, []
    for planes in at.planes:
        rows = per_obstacle * len(planes.normals)
        rooms.append(at.slack[row : row + rows].reshape(-1, per_obstacle).min(axis=1, initial=math.inf))
        row += rows
    room = np.concatenate(rooms) - safety.clearance_margin
    normals = np.concatenate([planes.normals[:, 0] for planes in at.planes])
    ahead = search.local_map.heading + (math.pi if backwards else 0.0)
    half_angles = np.arccos(np.clip(room / way_ahead(safety.robot), 0.0, 1.0))
    return np.arctan2(normals[:, 1], normals[:, 0]) - ahead, half_angles


def free_turn(middles: Array, half_angles: Array) -> float:
    """Return the smallest turn [rad] to a direction outside all sectors, positive to the left; infinite without one.

    >>> free_turn(np.array([0.5]), np.array([0.75])), free_turn(np.array([]), np.array([]))
    (-0.25..., 0.0)
    """
    left, right = _edge(middles, half_angles), _edge(-middles, half_angles)
    return left if left <= right + BEYOND_EDGE else -right


def _edge(middles: Array, half_angles: Array) -> float:
    """Return the smallest angle >= 0 [rad] outside all sectors; infinite if they cover the whole circle."""
    angle = 0.0
    while angle < math.tau:
        off = np.remainder(middles - angle + math.pi, math.tau) - math.pi
        beyond = (off + half_angles)[np.abs(off) < half_angles]
        if not beyond.size:
            return angle
        angle += float(beyond.max()) + BEYOND_EDGE
    return math.inf
