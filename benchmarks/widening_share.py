"""Compare two rules for the scores that widen the sets (docs/method.md §15).

    python -m benchmarks widening

A skid steer (examples/own_log) is certified from fifteen minutes of its log, and then drives for twenty more: as it
was, and after all lags grew by half and it turned 15 % less. `largest`: the largest score counts. `let out`: as many of
the largest scores as the model set lets out do not count. A window is outside if it leaves its sets, as they were
widened at its start.
"""

from __future__ import annotations

import importlib
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.model_peers import OWN_LOG, own_log
from benchmarks.timing import Figures
from brakeline import Dataset, Filter, ModelConfig, Request, Shapes
from brakeline.deploy.data.importer import import_sources
from brakeline.messaging.robot import robot_named
from brakeline.safety.filter.widening import Widening
from brakeline.safety.model.model_config import ONE_STEP
from brakeline.safety.model.one_step_fitting import fit_one_step

OUTSIDE = 0.015
RECORDED, DRIVEN = 15.0, 20.0  # minutes
LAG_FACTOR, TURN_FACTOR = 1.5, 0.85  # of the change
MINUTE = 600  # periods of 0.1 s


def run() -> Figures:
    """Return a row for each rule and driving."""
    own_log()  # makes drive.py importable
    skid = importlib.import_module("drive").VEHICLES["skid"]
    changed = replace(skid, rates=lambda s, speed, turn: _slower(skid, s, speed, turn))
    model, _ = fit_one_step(driven(skid, RECORDED, 1), ModelConfig(mode=ONE_STEP, outside=OUTSIDE))
    filter = Filter(model)
    before = driven(skid, DRIVEN, 2)
    figures: Figures = {}
    for driving, data in (("as recorded", driven(skid, DRIVEN, 3)), ("changed", driven(changed, DRIVEN, 3))):
        for rule, share in (("largest", 0.0), ("let out", OUTSIDE)):
            widening = Widening(filter.robot)
            judged(filter, widening, before, share)  # so that a change meets a full memory
            figures[f"{driving}, {rule}"] = judged(filter, widening, data, share)
    return figures


def driven(vehicle: Any, minutes: float, seed: int) -> Dataset:
    """Return a drive of a vehicle, as `brakeline import` reads it."""
    drive = importlib.import_module("drive")
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.csv"
        rows = [",".join((*drive.OTHER_COLUMNS, *vehicle.state, *vehicle.inputs))]
        rows += [",".join(f"{value:.6g}" for value in row) for row in drive.rows(vehicle, minutes, seed)]
        log.write_text("\n".join(rows) + "\n")
        return import_sources([log], robot_named(str(OWN_LOG / "skid.toml"))).data


def judged(filter: Filter, widening: Widening, data: Dataset, share: float) -> dict[str, float]:
    """Score all windows of a drive, and return how many left their sets as widened, and the mean widening."""
    robot, left = filter.robot, []
    starts: list[float] = []  # the factor of each period's request
    nothing = Shapes.of([], robot.position_dim)
    for trajectory in data.trajectories:
        widening.interrupt()
        inputs = [
            trajectory.before if trajectory.before is not None else np.zeros(robot.action_dim),
            *trajectory.inputs,
        ]
        for state, before, action in zip(trajectory.states, inputs, trajectory.inputs, strict=False):
            request = Request(state, action, before, np.zeros((robot.horizon, robot.action_dim)), nothing)
            if (scores := filter.scores(replace(request, past=widening.past))) is not None:
                score, plan_score = scores
                widening.judge(score, share, plan_score)
                left.append(plan_score > starts[-robot.horizon])
            starts.append(widening.factor)
            widening.executed(state, before, action)
    shares = np.array(left)
    return {
        "windows": float(len(shares)),
        "outside %": 1e2 * float(shares.mean()),
        "first minute %": 1e2 * float(shares[:MINUTE].mean()),
        "afterwards %": 1e2 * float(shares[MINUTE:].mean()),
        "mean widening": float(np.mean(starts)),
    }


def _slower(vehicle: Any, s: Any, speed: Any, turn: Any) -> tuple[Any, ...]:
    """Return the rates of a robot with a payload: it follows its inputs more slowly, and turns less."""
    *moving, ahead, turning = vehicle.rates(s, speed, TURN_FACTOR * turn)
    return *moving, ahead / LAG_FACTOR, turning / LAG_FACTOR
