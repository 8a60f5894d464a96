"""A robot that cannot even stand verified recovers: slowly, never nearer, and the decision says so."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brakeline.deploy.data.environment_episodes import collect
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Disc
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.scan import Scan
from brakeline.safety.action_mapping import normalised
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.recovery import least_violating, lexicographically_less, slow_inputs
from brakeline.safety.filter.request import FAILSAFE, RECOVERING
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.in_process import InProcess
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import request
from tests.safety.test_scan_free_space import FAN, cast
from tests.safety.toys import SUBSTEPS, Toy, seen
from tests.safety.unicycle import Unicycle

BODY = GROUND.footprint


def test_slow_inputs_are_slow_and_within_bounds():
    for robot in (GROUND, QUADROTOR):
        inputs = slow_inputs(robot)
        assert (inputs >= robot.low()).all() and (inputs <= robot.high()).all()
        assert (np.abs(inputs[:, np.array(robot.translates)]).max(axis=0) <= 0.3 * robot.high().max()).all()
        assert (inputs == 0.0).all(axis=1).any()


def test_the_way_out_lowers_the_worst_violation_and_raises_none():
    standing, ends = np.array([0.05, 0.02, -0.1]), np.ones(3, dtype=bool)
    better = np.array([[0.04, 0.02, -0.1], [0.03, 0.025, -0.1], [0.03, 0.0, -0.1], [0.05, 0.02, -0.1]])
    assert least_violating(better, standing, ends) == 2
    assert least_violating(better[[1, 3]], standing, ends) is None  # the one harms, the other helps nothing
    small, large = np.array([1.0, 0.0]), np.array([1.0, 1.0])
    assert lexicographically_less(small, large) and not lexicographically_less(large, large)


def drive(ready, steps, see, action=(0.25, 0.0), noise=1.0):
    """Yield the answer and the robot's true state before each step; see: (true, measured) -> arguments of `decide`."""
    robot, safety = Unicycle((0.0, 0.0, 0.0), np.random.default_rng(0), noise), InProcess(ready, accept_bound=1.0)
    for _ in range(steps):
        true, measured = robot.state.copy(), robot.measure()
        answer = safety.decide(measured, action, **see(true, measured))
        yield answer, true
        robot.step(answer.action)


@pytest.mark.parametrize("sensed", [False, True], ids=["map", "scan"])
@pytest.mark.parametrize("angle", [0.0, 1.5, 3.1, -2.0])
def test_a_robot_too_close_to_an_obstacle_gets_away_and_drives_on(ready, angle, sensed):
    """The obstacle reaches a few centimetres into the body's disc, at any bearing. The policy wants straight ahead."""
    at, radius = (0.1 + BODY - 0.045) * np.array([math.cos(angle), math.sin(angle)]), 0.1
    pillar = Obstacle("cylinder", tuple(at), (radius,))

    def see(true, measured):
        if not sensed:
            return {"obstacles": [pillar]}
        ranges = cast([pillar], true[:2], FAN + true[2])
        return {"scan": Scan(ranges, FAN, tuple(measured[:3]), position_error=0.02)}

    kinds, gaps = [], []
    for answer, true in drive(ready, 121, see):
        kinds.append(answer.kind)
        gaps.append(float(np.linalg.norm(true[:2] - at)) - radius)
        assert answer.verified or answer.kind != "allowed"
        if answer.kind == RECOVERING:
            assert not answer.verified and not answer.plan[-1].any()
            assert abs(answer.plan[0][0]) <= 0.3 * 0.25 + 1e-9
    assert kinds[0] == RECOVERING
    assert min(gaps) >= gaps[0] - 0.003 and gaps[-1] > BODY
    assert kinds[-1] != RECOVERING and "allowed" in kinds


@pytest.mark.parametrize(
    "obstacle",
    [
        Obstacle("cylinder", (0.15, 0.0), (0.2,), margin=-BODY),
        Obstacle("cylinder", (-0.11, 0.08), (0.2,), margin=-BODY),
        Obstacle("box", (0.0, 0.4), (1.0, 0.95), 0.3, margin=-BODY),
        Obstacle("wall", (-0.06, 0.0), (), math.pi, margin=-BODY),
    ],
    ids=["ahead", "beside", "box", "wall"],
)
def test_a_robot_with_its_middle_in_a_hazard_is_led_out(ready, obstacle):
    """A hazard counts the body's middle, so the margin takes the body off. The policy wants straight ahead."""
    shapes, kinds, depths = Shapes.of([obstacle], 2), [], []
    for answer, true in drive(ready, 300, lambda *_: {"obstacles": [obstacle]}):
        kinds.append(answer.kind)
        depths.append(float(np.linalg.norm(shapes.to_surface(true[:2]))))
        assert answer.verified or answer.kind in (RECOVERING, "failsafe")
        assert not (answer.verified and depths[-1] > 0.0) or answer.kind == "failsafe"
    assert kinds[0] == RECOVERING and depths[0] > 0.0
    assert max(depths) <= depths[0] + 0.003 and depths[-1] == 0.0
    assert kinds[-1] in ("allowed", "adjusted")


def test_a_robot_that_may_be_too_close_by_less_than_the_measurement_errors_stands(ready):
    near = 0.1 + BODY - 0.01
    decision = ready.decide(request(action=(0.25, 0.0), obstacles=[Obstacle("cylinder", (near, 0.0), (0.1,))]))
    assert decision.kind == "failsafe" and decision.verified


@pytest.mark.parametrize("ranges, least", [(np.nan, 0.0), (3.5, 3.5)], ids=["nothing seen", "all seen"])
def test_no_way_out_is_known_where_a_scan_shows_nothing(ready, monkeypatch, ranges, least):
    """Odometry may jump, or a sensor may measure nothing: the robot must not drive off.

    A request refuses a pose so far away, but not that of a robot whose largest speed is not known.
    """
    monkeypatch.setattr("brakeline.safety.filter.scan_checks._largest_rate", lambda *_: math.inf)
    scan = Scan(np.full(len(FAN), ranges), FAN, pose=(0.0, 0.0, 0.0), age=0.2)
    for distance in (0.01, 0.3, 0.75, 1.25, 2.5, 3.0, 3.51, 5.0, 40.0):
        for i, angle in enumerate(np.radians(np.arange(0, 360, 40))):
            for heading in np.radians(np.arange(30 * (i % 3), 360, 90)):  # three angles cover all twelve headings
                at = (distance * math.cos(angle), distance * math.sin(angle), heading, 0.0, 0.0)
                decision = ready.decide(request(at, (0.0, 0.0), scan=scan))
                assert decision.kind != RECOVERING or distance < least, (at, decision.plan)
                if distance > least:
                    assert decision.kind == "failsafe" and not decision.plan.any()


@pytest.mark.parametrize("ahead", [-0.05, -0.02, 0.05])
@pytest.mark.parametrize("degrees", [90, 135])
def test_no_way_leads_out_of_space_about_which_a_scan_has_no_information(ready, ahead, degrees):
    """A robot whose sensor does not see behind it once crept ahead without end, and without a proposal to drive."""
    fan = np.radians(np.arange(-degrees, degrees + 1.0))
    free = Scan(np.full(len(fan), 3.5), fan, pose=(0.0, 0.0, 0.0), mount=(ahead, 0.0))
    decision = ready.decide(request((0, 0, 0, 0, 0), (0.0, 0.0), scan=free))
    assert decision.margin < 0.0 and decision.kind == FAILSAFE and not decision.plan.any()


def test_no_way_leads_out_of_space_about_which_a_range_image_has_no_information():
    """An image without beams down once had a hovering aircraft climb."""
    rings = np.radians(np.arange(-12.0, 91.0, 2.0))
    known = {"low": rings[0], "high": rings[-1], "mount": (0.0, 0.0, -0.1)}
    blind = RangeImage(np.full((len(rings), 180), 20.0), (0.0, 0.0, 5.0), **known)
    answer = InProcess(Filter.load("quadrotor")).decide([0.0, 0.0, 5.0, *[0.0] * 6], np.zeros(3), scan=blind)
    assert answer.margin < 0.0 and answer.kind == FAILSAFE and not answer.plan.any()


@pytest.fixture(scope="module")
def long_filter(data):
    """A body of five discs, half a metre long."""
    body = tuple(Disc((x, 0.0), 0.08) for x in (-0.25, -0.12, 0.0, 0.12, 0.25))
    return Filter(fit_model_set(replace(data, robot=replace(data.robot, body=body)), ModelConfig("residual", "direct")))


def wall_scan(state, wall, **errors):
    """Return a scan of a wall to the left, at y = `wall` m."""
    ranges = cast([Obstacle("wall", (0.0, wall), yaw=-math.pi / 2)], state[:2], FAN + state[2])
    return Scan(ranges, FAN, tuple(state[:3]), range_error=0.02, **errors)


@pytest.mark.parametrize("wall", [0.09, 0.1, 0.12])
@pytest.mark.parametrize("errors", [{}, {"position_error": 0.03, "heading_error": 0.05}])
def test_a_long_body_beside_a_wall_does_not_swing_its_rear_into_it(long_filter, wall, errors):
    def see(_, measured):
        return {"obstacles": [], "scan": wall_scan(measured, wall, **errors)}

    for _, true in drive(long_filter, 13, see, (0.1, 0.0), noise=0.0):
        assert true[1] + 0.25 * abs(math.sin(true[2])) + 0.08 < wall - 0.002


def test_the_way_out_leads_away_from_the_nearest_of_map_and_scan(ready):
    """The scan shows a wall 6 cm to the left. The map shows a post on the other side, farther off."""
    post = Obstacle("cylinder", (-0.3, -0.1), (0.08,))

    def see(_, measured):
        return {"obstacles": [post], "scan": wall_scan(measured, BODY + 0.06 - 0.075)}

    kinds = [answer.kind for answer, _ in drive(ready, 60, see, noise=0.0)]
    assert kinds[0] == RECOVERING and kinds[-1] != RECOVERING


HOVERER = robot_from_description(
    {
        "name": "toy-hoverer",
        "period": 0.2,
        "sight": 6.0,
        "state": {name: {"unit": "m", "role": "position", "error": 0.01} for name in "xy"}
        | {f"v{name}": {"unit": "m/s", "error": 0.01, "follows": f"v{name} setpoint"} for name in "xy"},
        "input": {f"v{name} setpoint": {"unit": "m/s", "low": -1.0, "high": 1.0, "slew": 0.5} for name in "xy"},
        "plan": {"horizon": 8, "free": 1, "brake": 2},
        "body": [{"at": [0.0, 0.0], "radius": 0.3}],
    }
)


class Hoverer(Toy):
    """A robot that reaches the given velocity, plus a wind that it does not know."""

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        self.given, self.wind = np.zeros(2), self.np_random.normal(0.0, 0.1, 2)
        return observation, info

    def step(self, action):
        wanted = self.low + 0.5 * self.width * (np.clip(np.asarray(action, float), -1.0, 1.0) + 1.0)
        slew = np.array(self.robot.action_slew)
        self.given = self.given + np.clip(wanted - self.given, -slew, slew)
        between = []
        for _ in range(SUBSTEPS):
            h = self.robot.period / SUBSTEPS
            self.wind += -h / 3.0 * self.wind + 0.1 * math.sqrt(2.0 * h / 3.0) * self.np_random.normal(size=2)
            velocity = self.state[2:] + h / 0.2 * (self.given + self.wind - self.state[2:])
            self.state = np.concatenate([self.state[:2] + h * velocity, velocity])
            between.append(self.state)
        self.worst = min(self.worst, self.clearance(np.array(between)))
        self.count += 1
        return self.state.copy(), 0.0, False, self.count >= self.steps, {}


def test_a_robot_that_drifts_where_it_hovers_moves_away_before_it_touches():
    """A verified stop may end beside a wall. A robot that does not stay there must not count as standing."""
    env = Hoverer(HOVERER, capsule=((0.0, 0.0), (0.0, 0.0), 0.3), steps=100_000)
    data = collect(env, HOVERER, 4500, held=6, state=seen, actions=normalised(HOVERER))
    filter = Filter(fit_model_set(data, ModelConfig()))
    assert not filter.constraints.stays
    env.obstacles = [Obstacle("cylinder", (1.42, 0.0), (1.0,))]

    def touches(episode):
        env.reset(seed=episode)
        env.worst, safety = np.inf, InProcess(filter, accept_bound=1.0)
        for _ in range(150):
            env.step(safety.decide(env.state, (1.0, 0.0), env.obstacles).action)
        return env.worst < 0.0

    assert not any(map(touches, range(5, 10)))
    filter.constraints.stays = True  # a mutant: wherever the robot stops, it stays
    assert any(map(touches, range(5, 10)))
