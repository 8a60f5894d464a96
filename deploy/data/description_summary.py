"""Summarise a robot description (`brakeline robot check`, `brakeline robot show`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from brakeline.messaging.labels import split_label
from brakeline.messaging.robot import HOLD, RAMP, Array, Robot

TEMPLATE_BODY = 0.2  # m: radius of the only disc of a new description, until somebody measures the robot
INFEASIBLE = 2  # scipy's status of a linear program without a solution


def full_stop_inputs(robot: Robot) -> Array:
    """Return the inputs (N, m) of the plan that begins with each input at its larger bound."""
    largest = np.where(np.abs(robot.low()) > np.abs(robot.high()), robot.low(), robot.high())
    return np.asarray(robot.plan_matrix() @ np.tile(largest, robot.free_steps)).reshape(robot.horizon, -1)


def nominal_stopping_distance(robot: Robot) -> float | None:
    """Return the length in m of a full stop of a robot without lag: an order of magnitude, not a bound.

    Return None if no input is a speed, as for a robot that takes accelerations: its largest speed is not known.
    """
    speeds = [i for i, label in enumerate(robot.action) if label.endswith("[m/s]") and robot.translates[i]]
    if not speeds:
        return None
    return float(np.linalg.norm(np.abs(full_stop_inputs(robot)[:, speeds]).sum(0))) * robot.period


def body_extent(robot: Robot) -> dict[str, float]:
    """Return how far the discs reach from the position of a robot with a heading [m]; empty for any other robot."""
    if robot.heading is None or robot.position_dim != 2:
        return {}
    sides = {"ahead": (1.0, 0.0), "behind": (-1.0, 0.0), "to_the_left": (0.0, 1.0), "to_the_right": (0.0, -1.0)}
    return {
        f"body_{side}_m": max(float(np.dot(disc.at, axis)) + disc.radius for disc in robot.body)
        for side, axis in sides.items()
    }


def stands_somewhere(robot: Robot) -> bool:
    """Return whether the robot can stand within its limits: only speeds whose input is held need not be zero."""
    if not robot.limits:
        return True
    from scipy.optimize import linprog  # here: it takes half a second to load

    held = [state for state, rule in zip(robot.follows, robot.stop, strict=True) if rule == HOLD]
    moves = [label.endswith(("/s]", "/s2]")) and k not in held for k, label in enumerate(robot.state)]
    rows, most = [limit.weights for limit in robot.limits], [limit.most for limit in robot.limits]
    bounds = [(0.0, 0.0) if moving else (None, None) for moving in moves]
    solution = linprog(np.zeros(len(moves)), A_ub=rows, b_ub=most, bounds=bounds, method="highs")
    return int(solution.status) != INFEASIBLE


def unmeasured_holds(robot: Robot) -> str:
    """Say which inputs a stop holds although no coordinate measures them. Empty if there are none."""
    inputs = zip(robot.action, robot.follows, robot.stop, strict=True)
    held = [split_label(label)[0] for label, follower, rule in inputs if rule == HOLD and follower < 0]
    if names := ", ".join(held):
        return (
            f'no state measures {names}, which a stop holds (stop = "hold"): the filter may verify nothing near an '
            'obstacle, not even driving away. Log it, or write stop = "ramp"'
        )
    return ""


def remarks(robot: Robot) -> list[str]:
    """Return remarks on settings that are valid but probably not intended."""
    distance = nominal_stopping_distance(robot) or 0.0
    error = max(robot.measurement_bound[: robot.position_dim], default=0.0)
    no_standing = robot.horizon == robot.free_steps + robot.brake_steps
    free = [label for label, index in zip(robot.action, robot.follows, strict=True) if index < 0]
    candidates = (
        (
            [(not any(disc.at), disc.radius) for disc in robot.body] == [(True, TEMPLATE_BODY)],
            f"body: one disc of {TEMPLATE_BODY:g} m around the position, as in the template. The filter keeps only "
            "this disc clear of obstacles, so measure the robot.",
        ),
        (
            robot.position_dim > 0 and distance + robot.footprint > robot.sight,
            f"sight: a stop from full speed takes about {distance:.2f} m and the body reaches {robot.footprint:.2f} m, "
            f"but the robot sees obstacles from {robot.sight:g} m only. The filter will rarely verify fast driving.",
        ),
        (
            2.0 * error > robot.sight,
            f"state: a position has an error of {error:g} m, but the robot sees obstacles from {robot.sight:g} m only. "
            "A tube begins with this error, so the filter will hardly verify anything. Is the error in m?",
        ),
        (
            no_standing and RAMP in robot.stop,
            "plan.horizon: no period of standing after the ramp: a robot with lag still moves when the plan ends",
        ),
        (
            not stands_somewhere(robot),
            "limit: no state without speed meets all limits. A plan that ends with standing leaves them.",
        ),
        (
            bool(free),
            f"state: no coordinate follows {', '.join(free)}: the half-width from full speed that `certify` reports is "
            "that of a robot that does not respond to this input yet",
        ),
        (bool(unmeasured_holds(robot)), f"input: {unmeasured_holds(robot)}"),
    )
    return [text for holds, text in candidates if holds]


def summary(robot: Robot) -> dict[str, Any]:
    """Return the main figures of a description, as JSON values."""
    rules = zip(robot.action, robot.action_low, robot.action_high, robot.action_slew, robot.stop, strict=True)
    distance = nominal_stopping_distance(robot)
    position = {"way_to_a_stop_m": distance, "footprint_m": robot.footprint, "discs": len(robot.body)}
    position |= body_extent(robot)
    return {
        "name": robot.name,
        "period_s": robot.period,
        "state": list(robot.state),
        "inputs": {
            label: {"low": low, "high": high, "slew": slew, "stop": list(rule) if isinstance(rule, tuple) else rule}
            for label, low, high, slew, rule in rules
        },
        "horizon": robot.horizon,
        "plan_s": robot.horizon * robot.period,
        "braking_s": robot.brake_steps * robot.period,
        **(position if robot.position_dim else {}),
        "limits": [limit.name for limit in robot.limits],
        "regressors": [robot.state[i] for i in robot.regressor],
        "layout": robot.layout(),
        "remarks": remarks(robot),
    }
