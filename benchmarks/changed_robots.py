"""How much of the shipped sets of plans a changed robot uses, beside what single periods show (docs/method.md §15).

    python -m benchmarks changed

Each changed robot is recorded as the shipped one was. A share is the largest ratio of an error to a stated half-width:
of the state after one period, and of the positions after each period of a plan. Above 1, a set was left.
"""

from __future__ import annotations

import numpy as np

from benchmarks.timing import Figures
from brakeline.deploy.data import collect
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.windows import PLAN, predicted_outputs, windows
from brakeline.sim.sim_conditions import Conditions, Wind

TRAJECTORIES, SEED = 30, 77
CHANGES = {
    "ground": {
        "as recorded": Conditions(),
        "payload 1 kg": Conditions(payload_kg=1.0),
        "payload 2 kg": Conditions(payload_kg=2.0),
        "weak motor, 60 %": Conditions(weak_motor=0.6),
        "friction 0.3": Conditions(floor_friction=0.3),
    },
    "quadrotor": {
        "as recorded": Conditions(),
        "payload 0.1 kg": Conditions(payload_kg=0.1),
        "payload 0.2 kg": Conditions(payload_kg=0.2),
        "weak motor, 80 %": Conditions(weak_motor=0.8),
        "wind 3 m/s": Conditions(wind=Wind(3.0, gust=0.5)),
    },
}


def run() -> Figures:
    """Return a row for each robot and change."""
    figures: Figures = {}
    for name, changes in CHANGES.items():
        robot, model = robot_with_task(name), ModelSet.load(name)
        for change, conditions in changes.items():
            driven = collect.record(robot, TRAJECTORIES, SEED, conditions)
            figures[f"{name}, {change}"] = shares(Dataset(robot, tuple(driven), {}), model)
    return figures


def shares(data: Dataset, model: ModelSet) -> dict[str, float]:
    """Return the largest shares that the plans in a data set use of the sets of a model set of mode direct."""
    d, used, plans = model.robot.position_dim, [], 0
    for k, step in enumerate(model.steps, 1):
        seen = windows(data, k, PLAN)
        off = np.abs(predicted_outputs(model.robot, seen.y) - seen.z @ step.C.T)
        part = off / step.half_widths(seen.z)
        used.append(part.max() if k == 1 else part[:, :d].max())
        plans = len(part)
    most = float(max(used))
    return {"plans": plans, "one period": float(used[0]), "a plan": most, "ratio": most / float(used[0])}
