"""Simulated real time: inputs take effect one period later, and goals follow each other without a reset."""

import numpy as np
import pytest

from brakeline.errors import BadInput
from brakeline.sim.arena_generator import arena_kind, draw_arena, goal_sequence
from brakeline.sim.delayed_vehicle import delayed
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.quadrotor_policies import QuadrotorRoutePolicy
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

ROBOT = QUADROTOR.in_real_time()


def test_each_input_is_executed_one_period_later() -> None:
    arena = staged_arena(start=(0.0, 0.0, 50.0), goal=(9.0, 9.0, 50.0), half_width=100.0, height=100.0)
    at_once = Quadrotor(arena, np.random.default_rng(3))
    late_vehicle = delayed(Quadrotor, ROBOT)(arena, np.random.default_rng(3))
    inputs = [*np.random.default_rng(4).uniform(-5.0, 5.0, (10, 3))]
    for executed, given in zip([np.zeros(3), *inputs[:-1]], inputs, strict=True):
        period, expected = late_vehicle.step(given), at_once.step(executed)
        assert period.true == pytest.approx(expected.true, abs=1e-12)
        assert period.measured == pytest.approx(expected.measured, abs=1e-12)
        assert (np.abs(late_vehicle.input - at_once.input) <= 0.8 + 1e-12).all(), "within the slew"
        assert (np.abs(late_vehicle.input - given) <= np.abs(at_once.input - given) + 1e-12).all(), "on the way to it"
    with pytest.raises(BadInput):
        late_vehicle.step(np.array([np.nan, 0.0, 0.0]))


def test_a_robot_in_real_time_has_the_same_kind_and_arenas() -> None:
    assert ROBOT.kind == QUADROTOR.kind == QUADROTOR.name != ROBOT.name
    assert arena_kind(ROBOT, "default") is arena_kind(QUADROTOR, "default")


@pytest.mark.parametrize("robot", [GROUND, ROBOT], ids=lambda robot: robot.name)
def test_a_goal_sequence_leads_from_goal_to_goal(robot) -> None:  # type: ignore[no-untyped-def]
    arena, kind = draw_arena("default", np.random.default_rng(5), robot), arena_kind(robot, "default")
    stages = goal_sequence(arena, 6, np.random.default_rng(6), robot)
    start = arena.start[: arena.dim]
    for stage in stages:
        assert stage.start == start and stage.obstacles == arena.obstacles
        assert np.linalg.norm(np.subtract(stage.goal, start)) >= kind.goal_distance
        assert stage.shapes.distance(np.array(stage.goal)).min() >= robot.footprint + kind.start_clearance
        assert stage.clearance_map is arena.clearance_map
        assert stage.clearance_map.connected(start, stage.goal, robot.footprint + kind.path_clearance)
        start = stage.goal


def test_a_prepared_policy_proposes_the_same_inputs() -> None:
    arena = draw_arena("default", np.random.default_rng(7), QUADROTOR)
    state = np.array([*arena.start, *np.zeros(6)])
    info = {"arena": arena, "goal": arena.goal, "state": state, "input_in_force": np.zeros(3)}
    unprepared, ready = (QuadrotorRoutePolicy(ROBOT, np.random.default_rng(0)) for _ in range(2))
    ready.prepare(arena)
    assert (unprepared(np.zeros(0, np.float32), info) == ready(np.zeros(0, np.float32), info)).all()
