"""Summarise a robot description and plot it (`brakeline robot check`, `brakeline robot show`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from brakeline.messaging.robot import FEEDBACK, HOLD, RAMP, Array, Robot


def full_stop_inputs(robot: Robot) -> Array:
    """Return the inputs (N, m) of the plan that begins with each input at its larger bound."""
    largest = np.where(np.abs(robot.low()) > np.abs(robot.high()), robot.low(), robot.high())
    return np.asarray(robot.plan_matrix() @ np.tile(largest, robot.free_steps)).reshape(robot.horizon, -1)


def nominal_stopping_distance(robot: Robot) -> float:
    """Return the length in m of a full stop of a robot without lag: an order of magnitude, not a bound."""
    speeds = [i for i, label in enumerate(robot.action) if label.endswith("[m/s]") and robot.translates[i]]
    return float(np.linalg.norm(np.abs(full_stop_inputs(robot)[:, speeds]).sum(0))) * robot.period


def remarks(robot: Robot) -> list[str]:
    """Return remarks on settings that are valid but probably not intended."""
    distance, no_standing = nominal_stopping_distance(robot), robot.horizon == robot.free_steps + robot.brake_steps
    free = [label for label, index in zip(robot.action, robot.follows, strict=True) if index < 0]
    candidates = (
        (
            robot.position_dim > 0 and distance + robot.footprint > robot.sight,
            f"sight: a stop from full speed takes about {distance:.2f} m and the body reaches {robot.footprint:.2f} m, "
            f"but the robot sees obstacles from {robot.sight:g} m only. The filter will rarely verify fast driving.",
        ),
        (
            no_standing and RAMP in robot.stop,
            "plan.horizon: no period of standing after the ramp: a robot with lag still moves when the plan ends",
        ),
        (bool(free), f"state: no coordinate follows {', '.join(free)}: half-widths are reported for rest only"),
    )
    return [text for holds, text in candidates if holds]


def summary(robot: Robot) -> dict[str, Any]:
    """Return the main figures of a description, as JSON values."""
    rules = zip(robot.action, robot.action_low, robot.action_high, robot.stop, strict=True)
    distance = nominal_stopping_distance(robot)
    position = {"way_to_a_stop_m": distance, "footprint_m": robot.footprint, "discs": len(robot.body)}
    return {
        "name": robot.name,
        "period_s": robot.period,
        "state": list(robot.state),
        "inputs": {
            label: {"low": low, "high": high, "stop": list(rule) if isinstance(rule, tuple) else rule}
            for label, low, high, rule in rules
        },
        "plan_s": robot.horizon * robot.period,
        "braking_s": robot.brake_steps * robot.period,
        **(position if robot.position_dim else {}),
        "limits": [limit.name for limit in robot.limits],
        "regressors": [robot.state[i] for i in robot.regressor],
        "layout": robot.layout(),
        "remarks": remarks(robot),
    }


def draw_description(robot: Robot, path: Path) -> None:
    """Plot the body from above (in joint space, the limits) and the stop of each input into the image `path`."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    body, plan = figure.subplots(1, 2)
    if robot.position_dim:
        for disc in robot.body:
            body.add_patch(Circle((disc.at[0], disc.at[1]), disc.radius, alpha=0.3))
        body.add_patch(Circle((0.0, 0.0), robot.footprint, fill=False, linestyle=":"))
        body.annotate("", (robot.footprint, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "->"})
        body.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"{robot.name}: body and footprint")
        reach = 1.2 * robot.footprint
        body.set(xlim=(-reach, reach), ylim=(-reach, reach))
    else:
        body.barh([limit.name for limit in robot.limits], [limit.most for limit in robot.limits], alpha=0.3)
        body.set(xlabel="largest value", title=f"{robot.name}: limits")
    times = robot.period * np.arange(robot.horizon + 1)
    for label, rule, values in zip(robot.action, robot.stop, full_stop_inputs(robot).T, strict=True):
        how = {RAMP: "ramp", HOLD: "held", FEEDBACK: "by feedback"}.get(str(rule), "profile")
        plan.stairs(values, times, baseline=None, label=f"{label}: {how}", linewidth=1.5)
    plan.set(xlabel="time [s]", ylabel="input", title="a plan from the largest inputs")
    plan.legend(fontsize="small")
    figure.savefig(path, dpi=120)
