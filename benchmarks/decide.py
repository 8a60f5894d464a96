"""`decide`, by kind of decision, of the ground robot for every certificate and mode, of the quadrotor, and of both by
what they see.

The paper's figures are 80.4 and 80.9 ms a step.
"""

from __future__ import annotations

from collections import defaultdict
from time import perf_counter

from benchmarks import situations
from benchmarks.timing import WARM_UP, Figures, milliseconds
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.error_bounds import KINDS
from brakeline.safety.model.model_set import MODES
from brakeline.sim.sim_conditions import Conditions, Perception

SCANS = Conditions(perception=Perception("scan"))


def run() -> Figures:
    asked = situations.messages()
    figures: Figures = {}
    for certificate in KINDS:
        for mode in MODES:
            ready = Filter(situations.model(certificate, mode))
            for kind, seconds in _by_kind(ready, asked).items():
                figures[f"{certificate} {mode}: {kind}"] = milliseconds(seconds) | {"count": len(seconds)}
    for name, robot, conditions in (
        ("quadrotor, residual direct", "quadrotor", None),
        ("ground by scan, residual direct", "ground", SCANS),
        ("quadrotor by scan, residual direct", "quadrotor", SCANS),
    ):
        of = robot_with_task(robot)
        asked = situations.messages(robot=of, conditions=conditions)
        for kind, seconds in _by_kind(Filter(situations.model(robot=of)), asked).items():
            figures[f"{name}: {kind}"] = milliseconds(seconds) | {"count": len(seconds)}
    figures["the paper, a step (its own machine)"] = {"mean ms": 80.41}
    return figures


def _by_kind(ready: Filter, asked: list[pb.Request]) -> dict[str, list[float]]:
    times = defaultdict(list)
    for i, request in enumerate(situations.requests(ready, asked)):
        before = perf_counter()
        kind = ready.decide(request).kind
        if i >= WARM_UP:
            times[kind].append(perf_counter() - before)
    return dict(sorted(times.items()))
