"""The log of a program of one's own: every request and step is in it, and it says how the robot followed its sets."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from brakeline.deploy.run.recorded_client import RecordedClient
from brakeline.errors import BadRequest, BusError, NoReply, Refused
from brakeline.logs.reader import open_log
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Disc, Robot
from brakeline.messaging.topics import DECIDE
from brakeline.safety.filter.filter import Filter
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.client import SafetyClient
from brakeline.safety.service.in_process import InProcess
from tests.faults.failing_calls import full
from tests.safety.served import Service
from tests.waiting import until

AHEAD = [Obstacle("cylinder", (0.6, 0.0), (0.1,))]
PERIODS = 12


@pytest.fixture(scope="module")
def method() -> Filter:
    return Filter.load("ground")


def after(state, action):
    """Return the state of a robot that follows its inputs at once."""
    v, w = action
    return np.array([state[0] + 0.2 * v * np.cos(state[2]), state[1] + 0.2 * v * np.sin(state[2]), state[2], v, w])


def drive(safety, periods=PERIODS, state=(0.0,) * 5, obstacles=AHEAD):
    """Drive straight at an obstacle, and return the state after each decision."""
    states = []
    for _ in range(periods):
        answer = safety.decide(state, [0.25, 0.0], iter(obstacles), known_free=True)
        state = after(state, answer.action)
        states.append(state)
    return np.array(states)


def known(client: SafetyClient) -> bool:
    """Return whether a service answers the client, if only to refuse an empty request."""
    try:
        client.bus.ask(DECIDE, b"", 5.0, robot="ground")
    except NoReply:
        return False
    except Refused:
        return True
    raise AssertionError("an empty request was decided")


def messages(log: Path, kind: str) -> list:
    return [record.message for record in open_log(log) if record.topic == kind]


def test_the_log_has_every_request_and_the_step_to_the_next_one(method, tmp_path, figures) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        states = drive(safety)
        safety.reset(goal=True)
        drive(safety)
    steps, exchanges = messages(safety.path, "step"), messages(safety.path, "exchange")
    assert [(e.request.episode, e.request.step) for e in exchanges] == [(k, i) for k in (0, 1) for i in range(PERIODS)]
    assert [(s.episode, s.step) for s in steps] == [(k, i) for k in (0, 1) for i in range(PERIODS - 1)]
    first = steps[: PERIODS - 1]
    assert np.array([s.state for s in first]).tolist() == states[:-1].tolist()
    executed = np.array([e.reply.decision.plan[:2] for e in exchanges[: PERIODS - 1]], np.float32)
    assert np.array([s.action for s in first], np.float32).tolist() == executed.tolist()
    assert [(s.episode, s.goal, s.terminated, s.truncated) for s in steps if s.terminated or s.truncated] == [
        (0, True, True, False),
        (1, False, False, True),
    ]
    nearest = 0.6 - 0.1 - max(s.state[0] for s in first) - method.robot.footprint
    assert min(s.closest for s in first) == pytest.approx(nearest)
    again = figures("replay", safety.path)
    assert (again["requests"], again["identical"] + again["equal"]) == (2 * PERIODS, 2 * PERIODS)


def test_the_clearance_is_that_of_the_turned_body(method, tmp_path, figures) -> None:
    """Not that of the circle about the position that contains it: a long robot passes where the circle does not."""

    class Long(InProcess):
        @property
        def robot(self) -> Robot:
            return replace(super().robot, body=(Disc((0.2, 0.0), 0.1), Disc((-0.2, 0.0), 0.1)))

    beside = [Obstacle("wall", (0.0, 0.25), yaw=-np.pi / 2)]
    with RecordedClient(Long(method), tmp_path / "mine") as safety:
        for heading in (0.0, 0.0, 0.1):
            safety.decide([0.0, 0.0, heading, 0.0, 0.0], [0.0, 0.0], beside)
    straight, turned = messages(safety.path, "step")
    assert straight.clearance == pytest.approx(0.15)
    assert turned.closest == pytest.approx(0.15 - 0.2 * np.sin(0.1))
    assert figures("analyse", safety.path)["closest_approach"] == pytest.approx(turned.closest)


def test_no_stated_collision_is_lost(method, tmp_path, figures) -> None:
    """Neither that of an episode with one decision, also without an answer, nor that of the last period but one."""
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        drive(safety, 1)
        safety.record_outcome(-1.0, collision=True)
        safety.reset()
        with pytest.raises(BadRequest):
            safety.decide([0.0] * 5, [0.2, 0.0])  # nothing is said of the space around
        safety.fallback()
        safety.reset(collision=True)
        drive(safety, 2)
        safety.record_outcome(-1.0, collision=True)
        drive(safety, 1)
        safety.reset()
        drive(safety, 1)
        safety.record_outcome(2.0, goal=True)
    counted = figures("analyse", safety.path)
    assert (counted["episodes"], counted["collisions"], counted["goals"], counted["steps"]) == (4, 3, 1, 5)
    assert counted["mean_reward"] == (-1.0 + 0.0 - 1.0 + 2.0) / 4
    first = messages(safety.path, "step")[0]
    assert first.state == [0.0] * 5 and first.speed == 0.0 and not first.compared
    assert first.clearance == pytest.approx(0.5 - method.robot.footprint)


def test_the_outcome_of_a_period_without_a_measured_end_is_not_lost(method, tmp_path, figures) -> None:
    """After it the program brakes without a request: at the end of an episode, or within one."""
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        for lead in (1, 3):
            drive(safety, lead)
            safety.record_outcome(-1.0, collision=True)
            safety.fallback()
            safety.record_outcome(-0.5)
            safety.reset()
            drive(safety, lead)
            safety.record_outcome(-1.0, collision=True)
            for _ in range(2):
                safety.fallback()
            drive(safety, 2)
            safety.reset()
        drive(safety, 2)
        safety.record_outcome(1.0, goal=True)
        safety.fallback()
        safety.reset()
        drive(safety, 2)
        with pytest.raises(BadRequest):
            safety.decide([0.0] * 5, [0.2, 0.0])  # and no `fallback`: the program stops by itself
        safety.record_outcome(-1.0, collision=True)
    counted = figures("analyse", safety.path)
    assert (counted["episodes"], counted["collisions"], counted["goals"]) == (6, 5, 1)
    assert counted["mean_reward"] == (-1.5 - 1.0 - 1.5 - 1.0 + 1.0 - 1.0) / 6
    assert all(len(step.state) == 5 for step in messages(safety.path, "step"))


def test_the_log_says_when_a_state_left_its_predicted_set(method, tmp_path) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        for x in (0.0, 0.001, 0.0, 0.3, 0.301, 0.3):  # it stands, and its position jumps once
            safety.decide([x, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0], known_free=True)
    steps = messages(safety.path, "step")
    assert [s.compared and s.contained for s in steps] == [True, True, False, True, True]
    assert not any(np.isfinite(s.closest) for s in steps), "nobody named an obstacle"


def test_a_period_without_a_decision_is_a_fallback(method, tmp_path) -> None:
    endpoint = free_endpoint()
    with Bus(BusSettings(listen=(endpoint,)), "safety") as bus:
        serving = bus.serve(DECIDE, Service(ModelSet.load("ground")).answer)
        with SafetyClient.open(endpoint, "ground", 5.0) as client, RecordedClient(client, tmp_path / "mine") as safety:
            state = drive(safety, 3)[-1]
            serving.close()
            with pytest.raises(BusError):
                safety.decide(state, [0.25, 0.0], AHEAD)
            braking = safety.fallback()
            bus.serve(DECIDE, Service(ModelSet.load("ground")).answer)
            until(partial(known, client), "the client knows the new service")
            safety.decide(after(state, braking), [0.25, 0.0], AHEAD)
    steps, exchanges = messages(safety.path, "step"), messages(safety.path, "exchange")
    assert [s.fallback for s in steps] == [False, False, False, True]
    assert np.array(steps[-1].action, np.float32).tolist() == braking.astype(np.float32).tolist()
    assert [bool(e.failure) for e in exchanges] == [False, False, False, True, False]


def test_a_bad_request_is_recorded_only_if_a_message_can_hold_it(method, tmp_path) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        with pytest.raises(BadRequest, match="known_free"):
            safety.decide([0] * 5, [0.2, 0.0])
        with pytest.raises(BadRequest, match="state"):
            safety.decide("here", [0.2, 0.0], known_free=True)
        assert safety.decide([0] * 5, [0.2, 0.0], known_free=True).kind == "allowed"
    assert [bool(e.failure) for e in messages(safety.path, "exchange")] == [True, False]


def test_a_log_is_never_written_over(method, tmp_path) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        drive(safety, 2)
    before = safety.path.read_bytes()
    with pytest.raises(FileExistsError, match="folder of its own"):
        RecordedClient(InProcess(method), tmp_path / "mine")
    assert safety.path.read_bytes() == before


def test_a_full_disk_does_not_stop_the_robot_and_is_reported_at_the_end(method, tmp_path, monkeypatch) -> None:
    def save(*_):
        raise full()

    safety = RecordedClient(InProcess(method), tmp_path / "mine")
    monkeypatch.setattr("brakeline.logs.segment.Segment.save", save)
    assert len(drive(safety, 3)) == 3
    with pytest.raises(OSError, match="messages are lost"):
        safety.close()


def test_a_wrapped_environment_ends_episodes(method, tmp_path) -> None:
    env = gymnasium.make("brakeline.envs:brakeline/Ground-v0")
    with RecordedClient(InProcess(method), tmp_path / "mine") as client:
        wrapped = SafetyWrapper(env, client)
        for seed in range(2):
            wrapped.reset(seed=seed)
            for _ in range(4):
                wrapped.step(np.array([0.2, 0.0]))
    assert [(s.episode, s.step) for s in messages(client.path, "step")] == [(k, i) for k in range(2) for i in range(3)]


class Lane(gymnasium.Env):
    """A robot that follows its inputs at once, for four periods: each earns 2, and the episode ends as it is named."""

    action_space = gymnasium.spaces.Box(np.array([0.0, -0.5]), np.array([0.25, 0.5]), dtype=float)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), dtype=float)
    ends = ("at_goal", "collision", "neither")

    def __init__(self):
        self.episode = -1

    def reset(self, *, seed=None, options=None):
        self.state, self.periods, self.episode = np.zeros(5), 0, self.episode + 1
        return self.state, {"state": self.state, "obstacles": []}

    def step(self, action):
        self.state, self.periods = after(self.state, action), self.periods + 1
        ended, end = self.periods == 4, self.ends[self.episode]
        info = {"state": self.state, "obstacles": [], "at_goal": end == "at_goal", "collision": end == "collision"}
        return self.state, 2.0, ended and end != "neither", ended and end == "neither", info


def test_the_log_of_a_wrapped_environment_has_its_rewards_and_how_its_episodes_ended(method, tmp_path, figures) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as client:
        env = SafetyWrapper(Lane(), client, penalty=1.0)
        for _ in Lane.ends:
            env.reset()
            while not any(env.step(np.array([0.2, 0.0]))[2:4]):
                pass
    steps = messages(client.path, "step")
    assert [[s.reward for s in steps if s.episode == k] for k in range(3)] == [[2.0, 2.0, 4.0]] * 3
    ends = [(s.goal, s.collision, s.terminated, s.truncated) for s in steps if s.terminated or s.truncated]
    assert ends == [(True, False, True, False), (False, True, True, False), (False, False, False, True)]
    run = figures("analyse", client.path)
    assert [run[name] for name in ("episodes", "goals", "collisions", "mean_reward")] == [3, 1, 1, 8.0]


def test_what_the_program_never_stated_is_not_recorded(method, tmp_path, figures, command) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        drive(safety)
    run = figures("analyse", safety.path)
    assert not run["outcomes_stated"] and run["intervals"]["collisions"] is run["intervals"]["goals"] is None
    status, out, _ = command("analyse", safety.path, "--html", tmp_path / "report.html")
    assert status == 0 and "not recorded" in out and "timeouts" not in out
    assert not re.search(r"collisions +0", out)
    page = (tmp_path / "report.html").read_text()
    assert "not recorded" in page and 'data-figure="collisions' not in page and "mean reward" not in page
    (training,) = run["training"].values()
    assert training["last"]["collisions"] is None is training["bins"][0]["goals"]


@pytest.mark.parametrize("by", ["record_outcome", "reset"])
def test_outcomes_count_as_stated_also_if_nothing_was_reached_or_hit(method, tmp_path, figures, command, by) -> None:
    """The usual case of a program without rewards: `analyse` said that it had not called what it had called."""
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        for _ in range(2):
            for _ in range(4):
                safety.decide([0] * 5, [0.0, 0.0], known_free=True)
                if by == "record_outcome":
                    safety.record_outcome(0.0)
            safety.reset(**({"collision": False} if by == "reset" else {}))
    run = figures("analyse", safety.path)
    assert run["outcomes_stated"] and (run["collisions"], run["timeouts"]) == (0, 2)
    assert run["intervals"]["collisions"] == pytest.approx([0.0, 0.842], abs=1e-3)
    assert "not recorded: the program" not in command("analyse", safety.path)[1]


def test_after_close_nothing_is_decided_unrecorded_and_the_robot_brakes(method, tmp_path) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        drive(safety, periods=4, obstacles=[])
    with pytest.raises(BusError, match=r"is closed.*another RecordedClient"):
        safety.decide([0.0] * 5, [0.25, 0.0], known_free=True)
    inputs = [safety.fallback() for _ in range(12)]
    assert np.array_equal(inputs[-1], [0.0, 0.0])


def test_a_reward_that_no_log_can_hold_counts_as_zero(method, tmp_path) -> None:
    with RecordedClient(InProcess(method), tmp_path / "mine") as safety:
        for reward in (np.nan, -np.inf, 1e300, 3.0, 0.0):
            safety.decide([0] * 5, [0.0, 0.0], known_free=True)
            safety.record_outcome(reward)
    assert [s.reward for s in messages(safety.path, "step")] == [0.0, 0.0, 0.0, 3.0]


def test_what_is_no_client_or_no_name_is_refused_before_a_log_begins(method, tmp_path) -> None:
    with pytest.raises(TypeError, match=r"not a Filter: give InProcess\(filter\)"):
        RecordedClient(method, tmp_path / "mine")
    with pytest.raises(ValueError, match="use up to 100 letters"):
        RecordedClient(InProcess(method), tmp_path / "mine", "my robot")
    assert not (tmp_path / "mine").exists()
