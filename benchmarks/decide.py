"""Time `decide` by kind of decision: ground robot with every error bound and mode, quadrotor, and both by scan.

Model sets of mode one-step decide the same requests as direct ones, in turn.

The paper's figures are 80.4 and 80.9 ms a step.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from time import perf_counter

import numpy as np

from benchmarks import situations
from benchmarks.timing import WARM_UP, Figures, milliseconds
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_config import DIRECT, KINDS, MODES, ONE_STEP
from brakeline.safety.model.model_set import ModelSet
from brakeline.sim.sim_conditions import Conditions, Perception

SCANS = Conditions(perception=Perception("scan"))
BLOCKS = 5  # of all requests; the least time of each request counts, since other processes disturb some


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
    for kind in ("ground", "quadrotor"):
        figures |= _one_step_beside_direct(kind)
    figures["the paper, a step (its own machine)"] = {"mean ms": 80.41}
    return figures


def _by_kind(name: str, model: ModelSet, asked: list[pb.Request]) -> Figures:
    safety_filter, times = Filter(model), defaultdict(list)
    for i, request in enumerate(situations.requests(safety_filter, asked)):
        before = perf_counter()
        kind = safety_filter.decide(request).kind
        if i >= WARM_UP:
            times[kind].append(perf_counter() - before)
    return {f"{name}: {kind}": milliseconds(times[kind]) | {"count": len(times[kind])} for kind in sorted(times)}


def _one_step_beside_direct(name: str) -> Figures:
    """Return the times of a robot's two model sets for the same requests of a trained policy and a random one.

    The requests come from driving behind the one-step model set, with its past windows and widenings. A direct model
    set scores no window, so it decides them without.
    """
    robot = robot_with_task(name)
    asked = [m for policy in ("trained", "random") for m in situations.messages(policy, robot=robot, mode=ONE_STEP)]
    filters = {mode: Filter(situations.model(mode=mode, robot=robot)) for mode in (DIRECT, ONE_STEP)}
    requests = {mode: list(situations.requests(safety_filter, asked)) for mode, safety_filter in filters.items()}
    requests[DIRECT] = [replace(request, past=None, widening=1.0) for request in requests[DIRECT]]
    least = {mode: np.full(len(asked), np.inf) for mode in filters}
    kinds = {mode: np.full(len(asked), "", dtype=object) for mode in filters}
    for _ in range(BLOCKS):
        for mode, safety_filter in filters.items():
            for i, request in enumerate(requests[mode]):
                before = perf_counter()
                kinds[mode][i] = safety_filter.decide(request).kind
                least[mode][i] = min(least[mode][i], perf_counter() - before)
    figures = {}
    for mode in filters:
        for kind in sorted(set(kinds[mode])):
            seconds = least[mode][kinds[mode] == kind]
            p95 = {"p95 ms": float(np.percentile(seconds, 95) * 1e3), "count": len(seconds)}
            figures[f"{name}, {mode}, least of {BLOCKS}: {kind}"] = milliseconds(seconds) | p95
    return figures
