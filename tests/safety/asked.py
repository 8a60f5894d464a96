"""Requests to the ground robot's filter, an exact check of its tubes, and the distance of reservations."""

from dataclasses import fields, is_dataclass

import numpy as np

from brakeline.messaging.obstacle import Obstacle, Shapes, rotate
from brakeline.safety.filter.request import Request
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.model.model_set import ModelSet
from tests.robots import GROUND

NONE = Shapes.of([], 2)
STILL = np.zeros((3, 2))
MEASURED = ("time_ms", "solve_ms", "verify_ms", "queue_ms", "plan_tokens")


def apart(one: Reservation, other: Reservation) -> float:
    """Return the distance [m] of two reservations in their nearest period; 0 or less if they overlap."""
    between = np.abs(one.center - other.center) - one.half_width - other.half_width
    return float((np.linalg.norm(np.maximum(between, 0.0), axis=1) - one.radius - other.radius).min())


def cylinder(x, y, radius=0.1):
    return Obstacle("cylinder", (x, y), (radius,))


def request(state=(0, 0, 0, 0, 0), action=(0.25, 0.0), obstacles=(), **more):
    """Return a request: by default, the robot stands in space that is known to be free."""
    state = np.array(state, float)
    return Request(
        state=state,
        action=np.array(action, float),
        input_in_force=more.pop("input_in_force", state[3:].copy()),
        plan=more.pop("plan", STILL),
        obstacles=obstacles if isinstance(obstacles, Shapes) else Shapes.of(list(obstacles), 2),
        known_free=more.pop("known_free", True),
        **more,
    )


def random_request(rng, count=4, nearest=0.27):
    heading, v, w = rng.uniform(-3, 3), rng.uniform(0, 0.25), rng.uniform(-0.5, 0.5)
    angles, ways = rng.uniform(-np.pi, np.pi, count), rng.uniform(nearest, 0.45, count)
    around = [cylinder(1 + r * np.cos(a), 2 + r * np.sin(a)) for a, r in zip(angles, ways, strict=True)]
    return request((1, 2, heading, v, w), rng.uniform([0, -0.5], [0.25, 0.5]), around)


def same(one, other):
    """Return whether two decisions, or parts of them, are equal in every bit but those of measured times."""
    if isinstance(one, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    if is_dataclass(one):
        names = [field.name for field in fields(one) if field.name not in MEASURED]
        return type(one) is type(other) and all(same(getattr(one, name), getattr(other, name)) for name in names)
    return one == other


def fits(model: ModelSet, ask: Request, free):
    """Return the distance [m] from the body in its tube, with the measurement error, to the nearest obstacle.

    It samples the boundary of each step's set and of the hull of two steps, without half-spaces.
    """
    z = np.concatenate([ask.state[3:], ask.input_in_force, free])
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = [np.zeros((1, 2))]
    for step in model.steps:
        half = (np.abs(step.W @ z) @ step.M.T + np.abs(z) @ step.kappa.T + step.w)[:2]
        corners.append(step.C[:2] @ z + half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]))
    chord_deviation = np.abs(z) @ model.chord_deviations.kappa.T + model.chord_deviations.w
    stopping_distance = (np.abs(z) @ model.stopping_distance.kappa.T + model.stopping_distance.w)[0]
    noise = np.array(GROUND.measurement_bound[:2]) * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    worst = np.inf
    for k in range(len(model.steps)):
        pairs = [(a, b) for a in corners[k] for b in corners[k + 1]]
        share = np.linspace(0, 1, 9)[:, None]
        chords = np.concatenate([a + share * (b - a) for a, b in pairs])
        grown = (chords[:, None] + GROUND.footprint * circle + chord_deviation[k] * circle).reshape(-1, 2)
        world = ask.state[:2] + rotate(grown, ask.state[2])
        world = (world[:, None] + noise).reshape(-1, 2)
        worst = min(worst, float(ask.obstacles.distance(world).min()))
    stopped = corners[-1][:, None] + (GROUND.footprint + stopping_distance) * circle
    world = ask.state[:2] + rotate(stopped.reshape(-1, 2), ask.state[2])
    return min(worst, float(ask.obstacles.distance((world[:, None] + noise).reshape(-1, 2)).min()))
