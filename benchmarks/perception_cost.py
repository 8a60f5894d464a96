"""Measure the cost of each source of free space: size of the messages, and time, on the ground and in the air.

A fleet asks once a period, in one message with a request for each robot. The times by kind of decision are those of
`decide`, by the clock. `answer` is the processor time of a request with decoding and encoding, which other load on the
machine changes less.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from time import process_time

import numpy as np

from benchmarks.decide import SCANS
from benchmarks.timing import WARM_UP, Figures
from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import RobotGroup, run_episode
from brakeline.deploy.experiments.evaluate import Evaluation, prepare_evaluation, prepare_fleet
from brakeline.logs.episode_stats import KINDS
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask, robot_with_task

STEPS = 600  # periods of each
SITUATIONS = {
    "map": ("ground", Evaluation()),
    "map, dense": ("ground", Evaluation(arena="dense")),
    "scan": ("ground", Evaluation(conditions=SCANS)),
    "scan, dense": ("ground", Evaluation(arena="dense", conditions=SCANS)),
    "map, walkers": ("ground", Evaluation(arena="walkers")),
    "map, many-walkers": ("ground", Evaluation(arena="many-walkers")),
    "fleet of 2": ("ground", Evaluation(arena="crossing", fleet=2)),
    "fleet of 4": ("ground", Evaluation(arena="crossing", fleet=4)),
    "fleet of 8": ("ground", Evaluation(arena="crossing", fleet=8)),
    "air, map": ("quadrotor", Evaluation()),
    "air, scan": ("quadrotor", Evaluation(conditions=SCANS)),
    "air, scan, dense": ("quadrotor", Evaluation(arena="dense", conditions=SCANS)),
}
POLICIES = ("trained", "random")  # the filter allows most inputs of the first, and half of those of the second


class Weighed:
    """Asks, and notes the size of each message [B] and the time of each kind of decision [ms]."""

    def __init__(self, question: Ask) -> None:
        self._question = question
        self.sizes: dict[str, list[int]] = defaultdict(list)
        self.times: dict[str, list[float]] = defaultdict(list)

    def __call__(self, requests: Sequence[pb.Request]) -> list[pb.Reply]:
        """Ask, and note sizes and times."""
        before = process_time()
        replies = list(self._question(requests))
        self.times["answer"].append(1e3 * (process_time() - before) / len(requests))
        for request, reply in zip(requests, replies, strict=True):
            self.sizes["request"].append(request.ByteSize())
            self.sizes["reply"].append(reply.ByteSize())
            self.times[KINDS[reply.decision.kind]].append(reply.decision.time_ms)
        return replies


def run(steps: int = STEPS) -> Figures:
    """Return a row for each source of free space."""
    return {name: _weighed(robot_with_task(robot), what, steps) for name, (robot, what) in SITUATIONS.items()}


def _weighed(robot: RobotWithTask, what: Evaluation, steps: int) -> dict[str, float]:
    sizes: dict[str, list[int]] = defaultdict(list)
    times: dict[str, list[float]] = defaultdict(list)
    for policy in POLICIES:
        asked = replace(what, policy=policy)
        if what.fleet:
            group, _, policies, question = prepare_fleet(robot, asked)
        else:
            driver, choose, question = prepare_evaluation(robot, asked)
            group, policies = RobotGroup([driver]), [choose]
        assert question is not None
        weighed = Weighed(question)
        taken = (1 for k in range(steps) for _ in run_episode(group, policies, weighed, k))
        sum(islice(taken, steps // max(1, what.fleet)))
        for name, values in weighed.sizes.items():
            sizes[name] += values
        for name, spent in weighed.times.items():
            times[name] += spent[WARM_UP:]
    figures = {f"{name} p50 B": float(np.median(values)) for name, values in sizes.items()}
    figures["request most B"] = float(max(sizes["request"]))
    figures |= {f"{kind} p50 ms": float(np.median(spent)) for kind, spent in times.items() if spent}
    return figures | {f"{kind} p99 ms": float(np.percentile(spent, 99)) for kind, spent in times.items() if spent}
