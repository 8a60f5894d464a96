"""Time `decide` by kind of decision: ground robot with every error bound and mode, quadrotor, and both by scan.

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
from brakeline.safety.model.model_set import MODES, ModelSet
from brakeline.sim.sim_conditions import Conditions, Perception

SCANS = Conditions(perception=Perception("scan"))


def run() -> Figures:
    """Return a row for each filter and kind of decision."""
    asked, figures = situations.messages(), Figures()
    for certificate in KINDS:
        for mode in MODES:
            figures |= _by_kind(f"{certificate} {mode}", situations.model(certificate, mode), asked)
    for name, kind, conditions in (
        ("quadrotor, residual direct", "quadrotor", None),
        ("ground by scan, residual direct", "ground", SCANS),
        ("quadrotor by scan, residual direct", "quadrotor", SCANS),
    ):
        robot = robot_with_task(kind)
        asked = situations.messages(robot=robot, conditions=conditions)
        figures |= _by_kind(name, situations.model(robot=robot), asked)
    figures["the paper, a step (its own machine)"] = {"mean ms": 80.41}
    return figures


def _by_kind(name: str, model: ModelSet, asked: list[pb.Request]) -> Figures:
    """Return the times of each kind of decision."""
    ready, times = Filter(model), defaultdict(list)
    for i, request in enumerate(situations.requests(ready, asked)):
        before = perf_counter()
        kind = ready.decide(request).kind
        if i >= WARM_UP:
            times[kind].append(perf_counter() - before)
    return {f"{name}: {kind}": milliseconds(times[kind]) | {"count": len(times[kind])} for kind in sorted(times)}
