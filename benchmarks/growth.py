"""Draw how the cost of a decision grows: with obstacles, requests at once, robots of a question, periods of a plan.

    python -m benchmarks growth

All figures are processor times of one thread, with requests of the trained policy. The model sets are those in use; for
longer plans, linear ones of the same recording. The plot is `docs/figures/growth.png`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import situations
from benchmarks.batch_decide import SIZES, batch_beside_loop, by_obstacle_count, processor_seconds
from benchmarks.timing import Figures
from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.simulated_recording import data_for
from brakeline.deploy.policy_loading import policy_named
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.dataset import RESTLESS, Dataset
from brakeline.safety.model.model_config import AUTO, DIRECT, ModelConfig
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from brakeline.safety.service.wire import MAX_REQUESTS

PLOT = Path(__file__).parents[1] / "docs" / "figures" / "growth.png"
ROBOTS = ("ground", "quadrotor")
TOGETHER = (1, 2, 4, 8, 16, 32, MAX_REQUESTS)  # robots of a question
HORIZONS = {"ground": (3, 4, 6, 8, 12, 16), "quadrotor": (8, 10, 12, 16)}
MINUTES = 150.0  # of recorded driving
SEED = 3  # of the order of its trajectories
DECISIONS = 400
SINGLE, BATCH = "one by one", "as a batch"


def run() -> Figures:
    """Return the processor time of a decision [µs] for each robot and way, by the number of what grows."""
    figures: Figures = {}
    for name in ROBOTS:
        robot = robot_with_task(name)
        safety_filter = Filter(situations.model(mode=AUTO, robot=robot))
        driven = islice(situations.driven("trained", 5, robot, mode=AUTO), SIZES[-1])
        messages = [outcome.request for _, outcome, _ in driven]
        requests = list(situations.requests(safety_filter, messages))
        figures |= _rows(name, "obstacles", by_obstacle_count(safety_filter, requests))
        figures |= _rows(
            name, "requests", [(size, batch_beside_loop(safety_filter, requests[:size])) for size in SIZES]
        )
        figures[f"{name}, robots of a question, the service"] = _together(safety_filter, messages)
        figures[f"{name}, periods of a plan, {SINGLE}"] = {str(n): _of_plans(robot, n) for n in HORIZONS[name]}
    _draw(figures)
    return figures


def _rows(name: str, what: str, rows: Sequence[tuple[int, dict[str, float]]]) -> Figures:
    ways = {SINGLE: "loop 1/s", BATCH: "batch 1/s"}
    return {f"{name}, {what}, {way}": {str(n): 1e6 / row[key] for n, row in rows} for way, key in ways.items()}


def _together(safety_filter: Filter, messages: list[pb.Request]) -> dict[str, float]:
    """Return the time of a service for each robot of a question, from bytes to bytes [µs]."""
    models = ModelRegistry()
    models.install(situations.model(mode=AUTO, robot=robot_with_task(safety_filter.robot.name)))
    handler = BatchHandler(models, ServiceCounts())
    row = {}
    for number in TOGETHER:
        some = [messages[i : i + number] for i in range(0, 4 * MAX_REQUESTS, number)]
        payloads = [pb.RequestBatch(requests=one).SerializeToString() for one in some]

        def work(payloads: list[bytes] = payloads) -> None:
            for payload in payloads:
                handler(payload)

        work()
        row[str(number)] = 1e6 * min(processor_seconds(work, 1) for _ in range(5)) / (4 * MAX_REQUESTS)
    return row


def part_of(data: Dataset, minutes: float) -> Dataset:
    """Return whole trajectories that last so long together, in a fixed random order; all of them if they are fewer.

    Restless ones are among them. They come last, as in the recording, and only mode one-step is fitted to them.
    """
    order, periods = np.random.default_rng(SEED).permutation(len(data.trajectories)), 60.0 * minutes / data.robot.period
    taken: list[int] = []
    for i in order.tolist():
        if sum(len(data.trajectories[k].inputs) for k in taken) >= periods:
            break
        taken.append(i)
    steady = len(data.steady().trajectories)
    about = data.about | {RESTLESS: str(sum(i >= steady for i in taken))}
    return replace(data, trajectories=tuple(data.trajectories[i] for i in sorted(taken)), about=about)


def _of_plans(robot: RobotWithTask, horizon: int) -> float:
    """Return the time of a decision with plans of so many periods [µs]."""
    other: dict[str, Any] = {"name": f"{robot.name}-{horizon}", "horizon": horizon}  # a name of its own for other plans
    longer, data = replace(robot, **other), part_of(data_for(robot), MINUTES)
    data = replace(data, robot=replace(data.robot, **other))
    safety, _ = certify(data, ModelConfig(mode=DIRECT).of_minutes())
    safety_filter, drive = (
        Filter(safety),
        situations.driven_behind(safety, policy_named("trained", robot, 0), 5, longer),
    )
    asked = list(situations.requests(safety_filter, [outcome.request for _, outcome, _ in islice(drive, DECISIONS)]))

    def work() -> None:
        for request in asked:
            safety_filter.decide(request)

    work()
    return 1e6 * min(processor_seconds(work, 1) for _ in range(5)) / len(asked)


def _draw(figures: Figures) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    panels = {
        "obstacles": "obstacles of a request",
        "requests": "requests at once",
        "robots of a question": "robots of a question",
        "periods of a plan": "periods of a plan",
    }
    figure, axes = plt.subplots(1, len(panels), figsize=(15.0, 3.6), constrained_layout=True)
    for (what, label), axis in zip(panels.items(), axes, strict=True):
        for title, row in figures.items():
            robot, about, way = title.split(", ")
            if about == what:
                _line(axis, robot, way, row)
        axis.set(xscale="log", yscale="log", xlabel=label)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("processor time of a decision [µs]")
    figure.savefig(PLOT, dpi=110, metadata={"Software": None})
    plt.close(figure)


def _line(axis: Any, robot: str, way: str, row: dict[str, float]) -> None:
    color = {"ground": "tab:blue", "quadrotor": "tab:orange"}[robot]
    style = "--" if way == BATCH else "-"
    axis.plot(
        [int(n) for n in row], list(row.values()), style, marker="o", markersize=3, color=color, label=f"{robot}, {way}"
    )
