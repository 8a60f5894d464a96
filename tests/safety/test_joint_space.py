"""Robots without a position: their limits are kept as obstacles are, and space is no word about them."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from brakeline.deploy.cli import main as brakeline
from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.environment_episodes import collect
from brakeline.deploy.run.recorded_client import RecordedClient
from brakeline.errors import BadDescription, BadRequest, BadShape, ErrorBoundError
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot_description import describe, robot_from_description
from brakeline.messaging.scan import Scan
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.recovery import slow_inputs
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, RECOVERING, Request
from brakeline.safety.filter.reservation import Reservation
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.model.calibration_samples import samples_of
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import DIRECT, ONE_STEP, RECURSION, ModelConfig, ModelSet
from brakeline.safety.model.windows import ways
from brakeline.safety.service.client import request_message
from brakeline.safety.service.in_process import InProcess
from tests.safety.asked import cylinder
from tests.safety.joints import MOST, JointEnvironment, Joints, joints, record
from tests.safety.served import ServiceClient

ARM = Path(__file__).parents[2] / "examples/two_link_arm/two_link_arm.toml"


@cache
def recorded(n=2):
    return record(joints(n), trajectories=3 if n == 2 else 2)


@cache
def certified(n=2):
    return certify(recorded(n), ModelConfig(mode=ONE_STEP))


@cache
def ready(n=2):
    return Filter(certified(n)[0])


def safety(n=2):
    return InProcess(ready(n), accept_bound=1.0)


# --- the description ----------------------------------------------------------------------------------------------


def test_the_command_line_checks_and_shows_an_arm_and_refuses_what_needs_a_task(capsys):
    assert brakeline(["robot", "check", str(ARM)]) == 0
    assert "4 coordinates, 2 inputs, no mistake" in capsys.readouterr().out
    assert brakeline(["robot", "show", str(ARM)]) == 0
    for command in ("collect", "evaluate", "train"):
        assert brakeline([command, str(ARM)]) != 0
        assert "has no position" in "".join(capsys.readouterr())


def test_a_description_without_a_position_has_neither_sight_nor_body():
    robot = joints(3)
    assert (robot.position_dim, robot.heading, robot.footprint, robot.body) == (0, None, 0.0, ())
    assert robot.regressor == tuple(range(6)) and robot.path_dim == 6
    assert robot_from_description(describe(robot)) == robot
    assert not {"sight", "body"} & describe(robot).keys()


@pytest.mark.parametrize(
    ("changes", "field", "word"),
    [
        ({"sight": 1.0}, "sight", "no sight"),
        ({"body": [{"at": [0.0, 0.0], "radius": 0.1}]}, "body", "no body"),
        ({"limit": []}, "limit", "needs a limit"),
        ({"state": {"q": {"unit": "rad", "error": 0.0, "regressor": False}}}, "state.q.regressor", "every coordinate"),
        ({"state": {"q": {"unit": "rad", "error": 0.0, "role": "heading"}}}, "state", "heading belongs"),
        (
            {"input": {"w": {"unit": "rad/s", "low": -1, "high": 1, "stop": {"q0": -1.0}}}},
            "input.w.stop",
            "not by gains",
        ),
    ],
)
def test_a_mistake_in_a_description_without_a_position_is_told(changes, field, word):
    with pytest.raises(BadDescription) as caught:
        joints(2, **changes)
    assert any(place == field and word in text for place, text in caught.value.problems), caught.value.problems


def test_limits_are_compared_in_units_of_half_their_distance():
    limits = [
        {"name": "up", "weights": {"q0": 1.0}, "most": 3.0},
        {"name": "down", "weights": {"q0": -1.0}, "most": 1.0},
        {"name": "alone", "weights": {"q1": 2.0}, "most": -0.5},
        {"name": "at zero", "weights": {"q0": 1.0, "q1": 1.0}, "most": 0.0},
    ]
    robot = joints(2, limit=limits)
    assert robot.limit_scales == pytest.approx([2.0, 2.0, 0.5, 1.0])
    assert robot.limit_values(np.array([1.0, 1.0, 9.0, 9.0])) == pytest.approx([0.5, -0.5, 4.0, 2.0])


# --- data and model sets ------------------------------------------------------------------------------------------


def test_an_excursion_is_how_far_a_limit_is_exceeded_between_two_ends():
    robot = joints(1)
    paths = np.zeros((4, 3, 2))
    paths[0, :, 0] = 0.1, 0.3, 0.2  # 0.1 above its end
    paths[1, :, 0] = -0.2, -0.1, 0.1  # 0.2 below its start, which the other limit sees
    paths[2, :, 0] = 0.05, 0.05, 0.0  # a stop: 0.05 above both ends
    states = np.zeros((5, 2))
    states[1:, 0] = 0.2, 0.3, 0.3, 0.3
    inputs = np.array([[1.0], [1.0], [0.0], [0.0]])
    chords, stops = ways(robot, Trajectory(states, inputs, paths, np.zeros(4)))
    assert chords == pytest.approx([0.1, 0.2, 0.05, 0.0])
    assert np.isnan(stops[[0, 1, 4]]).all() and stops[2:4] == pytest.approx([0.05, 0.0])


def test_the_stated_shares_hold_on_fresh_driving():
    model, report = certified()
    fresh = samples_of(record(model.robot, seed=9, trajectories=6))
    off = np.abs(fresh.after - model.one_step.rollouts(model.robot, fresh.z))
    widths = np.stack([step.half_widths(fresh.z) for step in model.steps], axis=1)
    outside = (off[..., :2] > widths[..., :2]).any((1, 2))
    outside |= (fresh.chords > model.chord_deviations.half_widths(fresh.z)).any(1)
    assert outside.mean() < report.bound_plan < 0.03 and outside.mean() < 0.005
    assert (off[:, 0] > widths[:, 0]).any(1).mean() < report.bound_step + 0.002
    assert (report.unit, report.clearance_margin) == ("1", 0.0)
    assert 0.0 < report.half_width_rest <= report.half_width_full < 0.05
    assert report.chosen.error < 0.02


def test_a_data_set_and_a_model_set_come_back_from_their_files(tmp_path):
    data, (model, _) = recorded(), certified()
    data.save(tmp_path / "data.safetensors")
    assert Dataset.load(tmp_path / "data.safetensors").digest() == data.digest()
    model.save(tmp_path / "model.safetensors")
    assert ModelSet.load(tmp_path / "model.safetensors").version == model.version


@pytest.mark.parametrize("mode", [DIRECT, RECURSION])
def test_the_linear_modes_are_refused(mode):
    with pytest.raises(ErrorBoundError, match="use mode one-step"):
        fit_model_set(recorded(), ModelConfig(mode=mode))


# --- decisions ----------------------------------------------------------------------------------------------------


def test_an_adversary_never_exceeds_a_limit_not_even_between_two_ends():
    robot, generator = joints(2), np.random.default_rng(3)
    arm, client, kinds, nearest = Joints(robot, generator), safety(), [], np.inf
    for _ in range(5):
        client.reset()
        arm.reset(generator.uniform(-0.8, 0.8, 2))
        for step in range(40):
            if step % 8 == 0:
                wanted = generator.choice([-1.0, 1.0], 2)
            answer = client.decide(arm.measured(), wanted)
            kinds.append(answer.kind)
            arm.drive(answer.action)
            nearest = min(nearest, MOST - np.abs(arm.true[:, :2]).max())
    assert 0.0 < nearest < 0.05
    assert kinds.count(ADJUSTED) > 50 and kinds.count(FAILSAFE) < 0.05 * len(kinds)


def test_a_proposal_is_allowed_inside_and_adjusted_at_the_limit_that_blocks_it():
    inside = safety().decide([0.0] * 4, [1.0, -1.0])
    assert inside.kind == ALLOWED and inside.verified and inside.tube_center.shape == (6, 0)
    near = safety().decide([0.85, 0.0, 0.0, 0.0], [1.0, -1.0])
    assert near.kind == ADJUSTED and near.verified
    assert near.action[0] < 0.9 and near.action[1] == pytest.approx(-1.0, abs=0.02)
    assert near.blocked_by.by == "q0 up" and near.blocked_by.room < 0.0 and not len(near.blocked_by.normal)
    assert 0.0 <= near.margin < 0.02 < inside.margin < MOST


def test_a_verified_plan_keeps_the_limits_for_every_state_of_its_sets():
    robot, generator, model = joints(2), np.random.default_rng(5), certified()[0]
    checked = 0
    for _ in range(80):
        state = np.concatenate([generator.uniform(-0.95, 0.95, 2), generator.uniform(-0.3, 0.3, 2)])
        before = generator.uniform(-0.3, 0.3, 2)
        plan = np.vstack([before * share for share in robot.stop_profile()])
        decision = ready().decide(Request(state, generator.uniform(-1.0, 1.0, 2), before, plan, Shapes.of([], 0)))
        if decision.kind not in (ALLOWED, ADJUSTED):
            continue
        z = np.concatenate([state, before, decision.plan.ravel()])[None]
        ends = model.one_step.rollouts(robot, z)[0, :, :2]
        half = np.stack([step.half_widths(z)[0, :2] for step in model.steps])
        beyond = model.chord_deviations.half_widths(z)[0, :, None] * MOST + robot.measurement_bound[0]
        starts = np.vstack([np.abs(state[None, :2]), (np.abs(ends) + half)[:-1]])
        assert (np.abs(ends) + half + beyond <= MOST + 1e-9).all() and (starts + beyond <= MOST + 1e-9).all()
        assert abs(ends[-1]).max() + half[-1].max() + model.stopping_distance.w[0] * MOST <= MOST + 1e-9
        checked += 1
    assert checked > 50


def test_the_widening_follows_a_weak_motor_and_keeps_the_limits():
    robot, generator = joints(2), np.random.default_rng(4)
    arm, client, factors = Joints(robot, generator, weak=0.7), safety(), []
    for step in range(100):
        answer = client.decide(arm.measured(), np.sign(np.sin([0.15 * step, 0.1 * step])))
        factors.append(client.backup_plan.widening.factor)
        arm.drive(answer.action)
        assert np.abs(arm.true[:, :2]).max() < MOST
    assert factors[0] == 1.0 and factors[-1] > 1.5 and answer.score is not None


def test_an_arm_that_moves_when_its_program_begins_has_no_verified_plan_to_stand():
    """Its first request names no plan, as that of a standing arm does."""
    filter, blind = ready(), np.array([np.nan, 0.0])
    bound, plan = np.array(filter.robot.measurement_bound), np.zeros((filter.robot.horizon, 2))
    first = Request(np.array([0.99, 0.0, 1.0, 0.0]), blind, plan[0], plan, Shapes.of([], 0))
    for state in (first.state, -first.state, np.array([0.0, 0.0, 5.0, 0.0])):  # the last one was never recorded
        decision = filter.decide(replace(first, state=state))
        assert (decision.kind, decision.verified) == (FAILSAFE, False)
    standing = np.array([0.99, 0.0, 0.0, 0.0])
    for state in standing + np.random.default_rng(0).uniform(-bound, bound, (50, 4)):  # as it may be measured
        decision = filter.decide(replace(first, state=state))
        assert (decision.kind, decision.verified) == (FAILSAFE, True)


def test_an_arm_whose_description_says_when_it_stands_drives_already_above_that_speed_at_any_angle():
    model = certified()[0]
    filter = Filter(replace(model, robot=replace(model.robot, stopped=0.05)))
    for speed, first in ((0.02, (ALLOWED, True)), (0.1, (FAILSAFE, False))):
        decision = InProcess(filter, accept_bound=1.0).decide([0.5, -0.5, speed, 0.0], [0.3, 0.0])
        assert (decision.kind, decision.verified) == first


def test_an_arm_that_stands_beyond_a_limit_recovers():
    arm, client, kinds = Joints(joints(2), np.random.default_rng(6)), safety(), []
    arm.reset(np.array([1.1, 0.0]))
    for _ in range(60):
        answer = client.decide(arm.measured(), [1.0, 0.0])
        kinds.append(answer.kind)
        assert answer.kind != RECOVERING or not answer.verified
        arm.drive(answer.action)
    assert RECOVERING in kinds and arm.true[-1, 0] < MOST


def test_any_number_of_joints():
    answer = safety(3).decide([0.85] * 3 + [0.0] * 3, [1.0, -1.0, 1.0])
    assert answer.kind == ADJUSTED and answer.action[1] == pytest.approx(-1.0, abs=0.03)
    alone = slow_inputs(joints(7))
    assert len(alone) == 1 + 3 * 7 and (np.count_nonzero(alone, axis=1) <= 1).all()


def test_a_robot_in_joint_space_can_be_recorded_and_analysed(tmp_path, capsys):
    """Its steps have no clearance. The second request ended in a traceback."""
    with RecordedClient(safety(), tmp_path / "mine") as client:
        assert [client.decide(np.zeros(4), np.zeros(2)).kind for _ in range(3)] == 3 * [ALLOWED]
    capsys.readouterr()
    assert brakeline(["analyse", str(tmp_path / "mine"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["steps"] == 2 and figures["closest_approach"] is None


# --- space is no word ---------------------------------------------------------------------------------------------


def test_what_only_a_robot_with_a_position_can_hit_is_refused():
    backup_plan = BackupPlan(joints(2))
    request = Request(np.zeros(4), np.zeros(2), backup_plan.input_in_force, backup_plan.plan, Shapes.of([], 0))
    assert ready().decide(request).kind == ALLOWED, "known_free is implied"
    for field, value in (
        ("obstacles", Shapes.of([cylinder(1.0, 0.0, 0.1)], 2)),
        ("scan", Scan(np.ones(8), 0.5 * np.arange(8.0), (0.0, 0.0, 0.0))),
        ("reservation", Reservation(np.zeros((6, 0)), np.zeros((6, 0)), np.zeros(6))),
    ):
        with pytest.raises(BadRequest, match="has no position") as caught:
            ready().decide(replace(request, **{field: value}))
        assert caught.value.field == field
    with pytest.raises(BadShape, match="without a position has no obstacles"):
        safety().decide([0.0] * 4, [0.0, 0.0], [cylinder(1.0, 0.0, 0.1)])


def test_a_service_decides_as_the_filter_does_in_process():
    client = ServiceClient(certified()[0])
    answer = client.decide([0.85, 0.0, 0.0, 0.0], [1.0, 0.0])
    alone = safety().decide([0.85, 0.0, 0.0, 0.0], [1.0, 0.0])
    assert (answer.kind, answer.blocked_by.by) == (ADJUSTED, "q0 up")
    assert answer.plan == pytest.approx(alone.plan, abs=1e-12)  # memory may be aligned otherwise
    assert answer.tube_center.shape == (0, 0)
    fleet = request_message(client.backup_plan, np.zeros(4), np.zeros(2), actor="a", fleet=["a"])
    assert "reserves no space" in client.service.error(fleet).message
    obstacle = request_message(client.backup_plan, np.zeros(4), np.zeros(2), [cylinder(1.0, 0.0, 0.1)])
    assert "only limits" in client.service.error(obstacle).message


def test_a_gymnasium_environment_needs_no_obstacles():
    env = SafetyWrapper(JointEnvironment(joints(2)), ready(), accept_bound=1.0)
    env.reset(seed=0)
    kinds = [env.step(np.array([1.0, -1.0], np.float32))[4]["safety"].kind for _ in range(20)]
    assert kinds[0] == ALLOWED and kinds[-1] == ADJUSTED and np.abs(env.unwrapped.arm.true).max() < MOST


def test_a_gymnasium_environment_records_its_own_data():
    robot = joints(2)
    data = collect(JointEnvironment(robot), robot, 200)
    assert data.periods == 200 and data.trajectories[0].paths.shape[1:] == (1, 4) and data.chord_deviation > 0.0
