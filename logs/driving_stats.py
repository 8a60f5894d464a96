"""Count by kind of driving how often robots left the sets that their model set states (docs/method.md §14)."""

from __future__ import annotations

import contextlib
import math
from collections import Counter, defaultdict
from collections.abc import Mapping

import numpy as np

from brakeline.logs.episode_stats import Figures
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.driving_kinds import driving_kinds

CHUNK = 512  # windows that are classified at once


class DrivingStats:
    """The scored windows of the robots of a log.

    A request holds the robot's last periods, of a plan's length, and the answer has their score. So the windows
    overlap, and each belongs to one or several kinds of driving.
    """

    def __init__(self, robots: RecordedRobots, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """metadata: of the log, with the statement of each model set in `model ROBOT`."""
        self._robots, self._metadata = robots, metadata
        self._waiting: defaultdict[str, list[pb.Exchange]] = defaultdict(list)  # by robot
        self._kinds: defaultdict[str, defaultdict[str, _Kind]] = defaultdict(lambda: defaultdict(_Kind))

    def exchange(self, exchange: pb.Exchange) -> None:
        """Add an exchange. One without a score, or whose window has another size than the robot's, does not count."""
        request, decision = exchange.request, exchange.reply.decision
        robot = self._robots.named(request.robot) if decision.HasField("score") else None
        if robot is None or not _is_whole(robot, request):
            return
        self._waiting[robot.name].append(exchange)
        if len(self._waiting[robot.name]) >= CHUNK:
            self._classify(robot)

    def figures(self) -> Figures:
        """Return for each robot and kind: number of `windows`, those `outside`, the largest score, the stated `bound`.

        `outside` counts windows of which a position, or the state after one period, left its stated set. The bound is
        None if the log does not state it, or if another model set scored a window.
        """
        for name in list(self._waiting):
            robot = self._robots.named(name)
            assert robot is not None
            self._classify(robot)
        return {
            name: {
                kind: {
                    "windows": counts.windows,
                    "outside": counts.outside,
                    "excess": counts.excess,
                    "bound": self._bound(name, kind, counts.models),
                }
                for kind, counts in kinds.items()
                if counts.windows
            }
            for name, kinds in self._kinds.items()
        }

    def _classify(self, robot: Robot) -> None:
        exchanges = self._waiting.pop(robot.name, [])
        if not exchanges:
            return
        n, reg = robot.state_dim, list(robot.regressor)
        z = np.array([[*_first(e, n, reg), *e.request.past_inputs] for e in exchanges], float)
        start = [0 if e.request.past_from_start else robot.horizon for e in exchanges]
        scores = np.array([e.reply.decision.score for e in exchanges])
        places = np.column_stack([np.zeros(len(start), dtype=np.int64), start])
        kinds = driving_kinds(robot, z, places)
        for kind, members in kinds.items():  # also kinds without a window, so that the order is always the same
            versions = Counter(exchanges[row].reply.decision.model for row in np.flatnonzero(members))
            self._kinds[robot.name][kind].add(scores[members], versions)

    def _bound(self, robot: str, kind: str, models: Counter[str]) -> float | None:
        about = self._metadata.get(f"model {robot}", {})
        if set(models) != {about.get("version")}:
            return None
        with contextlib.suppress(KeyError, ValueError):
            bound = float(about[f"bound_plan {kind}"])
            return bound if 0.0 <= bound <= 1.0 else None
        return None


class _Kind:
    """The windows of one kind of driving. models: how many each model set scored, by version."""

    def __init__(self) -> None:
        self.windows = self.outside = 0
        self.excess = 0.0
        self.models: Counter[str] = Counter()

    def add(self, scores: Array, models: Counter[str]) -> None:
        self.windows += len(scores)
        self.outside += int((~(scores <= 1.0)).sum())
        self.excess = max(self.excess, float(np.nan_to_num(scores, nan=math.inf).max(initial=0.0)))
        self.models.update(models)


def _is_whole(robot: Robot, request: pb.Request) -> bool:
    """Return whether a request holds the finite window of a plan's length."""
    sizes = robot.horizon * robot.state_dim, (robot.horizon + 1) * robot.action_dim
    past = request.past_states, request.past_inputs
    return tuple(map(len, past)) == sizes and all(map(math.isfinite, (*past[0], *past[1])))


def _first(exchange: pb.Exchange, n: int, regressor: list[int]) -> list[float]:
    """Return the regressors of the window's first state."""
    state = exchange.request.past_states[:n]
    return [state[k] for k in regressor]
