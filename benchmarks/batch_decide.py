"""Time `decide_batch` beside the loop over `decide`, on one core, and compare their decisions.

The requests are those of a trained, a random and an adversary policy behind the filter. Each ratio is of two times of
the same block, and the interval is of all blocks. The time of the processor counts, so other processes disturb little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from time import process_time

import numpy as np

from benchmarks import situations
from benchmarks.timing import Figures, spread_of
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.batch.decision_arrays import KINDS, DecisionArrays
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Decision, Request
from brakeline.safety.model.model_set import DIRECT, ONE_STEP

ROWS, BLOCKS = 4096, 5
SIZES = (1, 16, 64, 256, 1024, ROWS)  # of batches
CROWDS = (1, 10, 30, 100, 300)  # obstacles of each request
POLICIES = ("trained", "random", "adversary")


def run() -> Figures:
    """Return a row for each robot, mode and policy, and rows that show how the time of a decision grows."""
    figures: Figures = {}
    for name in ("ground", "quadrotor"):
        for mode in (ONE_STEP, DIRECT):
            for policy in POLICIES:
                safety_filter, requests = filter_and_requests(name, mode, policy)
                title = f"{name}, {mode}, {policy}"
                figures[title] = batch_beside_loop(safety_filter, requests) | decision_differences(
                    safety_filter, requests
                )
                if mode == ONE_STEP and policy == "trained":
                    figures |= {
                        f"{title}: batch of {size}": batch_beside_loop(safety_filter, requests[:size]) for size in SIZES
                    }
                    figures |= {
                        f"{title}: {count} obstacles": row for count, row in by_obstacle_count(safety_filter, requests)
                    }
    return figures


def filter_and_requests(name: str, mode: str, policy: str) -> tuple[Filter, list[Request]]:
    """Return a filter, and the requests of a policy that drives behind it."""
    robot = robot_with_task(name)
    safety_filter = Filter(situations.model(mode=mode, robot=robot))
    driven = islice(situations.driven(policy, situations.SEED, robot, mode=mode), ROWS)
    return safety_filter, list(situations.requests(safety_filter, [outcome.request for _, outcome, _ in driven]))


def batch_beside_loop(safety_filter: Filter, requests: list[Request]) -> dict[str, float]:
    """Return the decisions a second of a batch and of the loop, and their ratio with the interval of all blocks."""
    arrays = RequestArrays.of(requests)
    repeats = max(1, 256 // len(requests))  # of short blocks, whose time is near the clock's resolution
    safety_filter.decide_batch(arrays)
    times = []
    for _ in range(BLOCKS):
        batch = processor_seconds(lambda: safety_filter.decide_batch(arrays), repeats)
        times.append(
            (batch, processor_seconds(lambda: [safety_filter.decide(request) for request in requests], repeats))
        )
    least, ratios = np.min(times, axis=0), np.array([loop / batch for batch, loop in times])
    return {"batch 1/s": len(requests) / least[0], "loop 1/s": len(requests) / least[1], **spread_of(ratios)}


def processor_seconds(call: Callable[[], object], repeats: int) -> float:
    """Return the processor time of a call [s]."""
    before = process_time()
    for _ in range(repeats):
        call()
    return (process_time() - before) / repeats


def decision_differences(safety_filter: Filter, requests: list[Request]) -> dict[str, float]:
    """Return how the decisions of a batch differ from those of the loop."""
    answers = safety_filter.decide_batch(RequestArrays.of(requests))
    single = [safety_filter.decide(request) for request in requests]
    kinds, apart = count_differences(answers, single)
    return {
        "decisions": len(requests),
        "singly %": 100.0 * len(answers.singly) / len(requests),
        "allowed %": 100.0 * sum(one.kind == KINDS[0] for one in single) / len(requests),
        "other kind": kinds,
        "apart": apart,
    }


def count_differences(answers: DecisionArrays, single: list[Decision]) -> tuple[int, float]:
    """Return the number of decisions of another kind, and the largest difference of an input of the others."""
    same = np.array([KINDS[kind] == one.kind for kind, one in zip(answers.kind, single, strict=True)])
    apart = np.abs(answers.plan - np.array([one.plan for one in single])).max(axis=(1, 2))
    return int((~same).sum()), float(apart[same].max(initial=0.0))


def by_obstacle_count(safety_filter: Filter, requests: list[Request]) -> list[tuple[int, dict[str, float]]]:
    """Return figures for requests with more and more obstacles between half the sight and the sight."""
    rng, d, sight = np.random.default_rng(0), safety_filter.robot.position_dim, safety_filter.robot.sight
    rows, some = [], requests[:512]
    for count in CROWDS:
        ways = rng.normal(size=(len(some), count, d))
        ways *= rng.uniform(0.5, 1.0, (len(some), count, 1)) * sight / np.linalg.norm(ways, axis=2, keepdims=True)
        around = [
            Shapes.of([Obstacle("sphere", tuple(request.state[:d] + way), (0.05,)) for way in own], d)
            for request, own in zip(some, ways, strict=True)
        ]
        changed = [replace(r, obstacles=o) for r, o in zip(some, around, strict=True)]
        rows.append((count, batch_beside_loop(safety_filter, changed)))
    return rows
