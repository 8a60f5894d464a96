"""A decision in a sentence: what was done, why, and where it was, for robots of several kinds."""

import re
from pathlib import Path

import numpy as np
import pytest

from brakeline.logs.decision_explanation import arrow, explain, sentence
from brakeline.logs.decision_view import decision_view
from brakeline.logs.episode_sampler import EpisodeRecord
from brakeline.logs.episode_view import rows
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot_description import read_robot
from tests.robots import GROUND, QUADROTOR

OMNI = read_robot(Path(__file__).parents[2] / "examples" / "omni" / "omni.toml")


def asked(robot, action, heading=0.0):
    state = [0.0] * robot.state_dim
    if robot.heading is not None:
        state[robot.heading] = heading
    return pb.Request(state=state, action=action)


def answered(robot, kind, action, by="cylinder", room=-0.03, after=None, normal=(), verified=True, **more):
    d, end = robot.position_dim, robot.horizon * robot.period
    rest = [0.0] * (robot.horizon - 1) * robot.action_dim
    decision = pb.Decision(kind=kind, plan=[*action, *rest], verified=verified, reason="why not", **more)
    if by:
        at = [0.3 * value for value in normal]
        decision.stopped.CopyFrom(
            pb.Stopped(by=by, room=room, after=end if after is None else after, normal=normal, at=at)
        )
    assert explain(robot, asked(robot, action), decision) or len(normal) not in (0, d)
    return decision


TOO_CLOSE = "the stop would have come 3 cm too close to the"
ADJUSTED = [
    (GROUND, (0.25, 0.0), (0.25, 0.4), (1, 0), f"turned left: straight on, {TOO_CLOSE} cylinder ahead"),
    (GROUND, (0.25, 0.2), (0.25, -0.4), (0, 1), "turned right: as proposed, the stop would have come 3 cm too"),
    (GROUND, (0.25, 0.0), (0.1, 0.0), (0.6, -0.8), "slowed down: as proposed, the stop"),
    (GROUND, (0.25, 0.0), (0.0, 0.0), (1, 0), "stopped: going on, the stop would"),
    (OMNI, (0.3, 0.0, 0.0), (0.2, 0.2, 0.0), (1, 0), f"turned to the left of the proposal: straight on, {TOO_CLOSE}"),
    (OMNI, (-0.3, 0.0, 0.0), (-0.2, 0.2, 0.0), (-1, 0), "turned to the right of the proposal: straight on"),
    (OMNI, (0.0, -0.3, 0.0), (0.0, -0.1, 0.0), (0, -1), f"slowed down: as proposed, {TOO_CLOSE} cylinder"),
    (OMNI, (-0.1, 0.3, 0.0), (0.0, 0.0, 0.0), (0, 1), f"stopped: going on, {TOO_CLOSE} cylinder on the left"),
    (OMNI, (0.3, 0.0, 0.0), (0.3, 0.0, 0.5), (1, 0), "turned left: straight on"),
    (QUADROTOR, (5.0, 0.0, 0.0), (3.0, 0.0, 0.0), (1, 0, 0), f"slowed down: as proposed, {TOO_CLOSE} cylinder in"),
    (QUADROTOR, (5.0, 0.0, 0.0), (4.0, 3.0, 0.0), (1, 0, 0), "turned to the left of the proposal: straight on"),
    (QUADROTOR, (5.0, 0.0, 0.0), (4.0, 0.0, 2.5), (1, 0, 0), "climbed: straight on"),
    (QUADROTOR, (5.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0, 0, -1), f"stopped: going on, {TOO_CLOSE} cylinder below"),
]


@pytest.mark.parametrize(("robot", "action", "instead", "normal", "said"), ADJUSTED)
def test_an_adjusted_action_is_described(robot, action, instead, normal, said):
    decision = answered(robot, pb.ADJUSTED, instead, normal=normal)
    assert sentence(robot, asked(robot, action), decision).startswith(said)


@pytest.mark.parametrize(
    ("heading", "normal", "where"),
    [(0.0, (1, 0), "ahead"), (0.0, (0, 1), "on the left"), (1.6, (1, 0), "on the right"), (3.0, (1, 0), "behind")],
)
def test_where_it_is_is_told_as_the_robot_looks(heading, normal, where):
    decision = answered(GROUND, pb.FAILSAFE, (0.0, 0.0), "wall", normal=normal)
    said = sentence(GROUND, asked(GROUND, (0.25, 0.0), heading), decision)
    assert said == f"braked along the plan verified before: as proposed, {TOO_CLOSE} wall {where}"


OTHER = [
    ({"room": 0.004}, "within 4 mm of the cylinder ahead, too near to move from there"),
    (
        {"room": 0.004, "for_clearance": True},
        "^stopped: going on, the stop would have come within 4 mm of the cylinder ahead: verified, but nearer than the "
        "clearance margin$",
    ),
    (
        {"by": "unseen", "room": -0.12, "after": 0.2, "normal": (0, 1)},
        r"it \(after 0.2 s\) would have come 12 cm too close to what is not seen on the left",
    ),
    ({"kind": pb.FAILSAFE, "by": "", "verified": False}, "^braked, though no plan is verified: why not$"),
    ({"kind": pb.FAILSAFE, "by": "moving cylinder", "normal": ()}, "the moving cylinder is touched already"),
    ({"kind": pb.RECOVERING, "by": ""}, "^slowly backs out"),
    ({"kind": pb.ALLOWED, "by": ""}, "^as proposed$"),
]


@pytest.mark.parametrize(("decided", "said"), OTHER)
def test_what_is_near_but_not_too_near_what_is_not_seen_and_what_is_unverified(decided, said):
    decision = answered(GROUND, **{"kind": pb.ADJUSTED, "action": (0.0, 0.0), "normal": (1, 0)} | decided)
    assert re.search(said, sentence(GROUND, asked(GROUND, (0.25, 0.0)), decision))


def test_arrows_go_where_the_inputs_go():
    ahead = arrow(GROUND, np.pi / 2, np.array([0.2, 0.0]))
    assert ahead == pytest.approx([0.0, 0.2 * 3 * GROUND.period])
    left = arrow(GROUND, 0.0, np.array([0.2, 0.5]))
    assert left[1] > 0.0 and np.hypot(*left) == pytest.approx(0.2 * 3 * GROUND.period)
    assert arrow(QUADROTOR, 0.0, np.array([1.0, -2.0, 0.5]))[1:] == pytest.approx(
        3 * QUADROTOR.period * np.array([-2.0, 0.5])
    )


def test_all_that_a_picture_needs_is_named_with_its_unit():
    decision = answered(GROUND, pb.ADJUSTED, (0.1, 0.2), normal=(1, 0))
    about = explain(GROUND, asked(GROUND, (0.25, 0.0)), decision)
    assert about.inputs == [("speed", "m/s", 0.25, 0.1), ("turn rate", "rad/s", 0.0, 0.2)]
    assert about.at == pytest.approx([0.3, 0.0]) and about.normal == pytest.approx([1.0, 0.0])


def test_what_has_another_robots_sizes_fits_not():
    request, decision = asked(GROUND, (0.25, 0.0)), answered(GROUND, pb.ADJUSTED, (0.1, 0.2), normal=(1, 0))
    assert explain(GROUND, request, decision) is not None
    assert explain(QUADROTOR, request, decision) is None
    decision.stopped.at.append(1.0)
    assert explain(GROUND, request, decision) is None


def test_a_proposal_that_is_not_finite_has_no_arrow():
    question, answer = asked(GROUND, (float("nan"), 0.1)), answered(GROUND, pb.FAILSAFE, (0.0, 0.0), by="")
    about = explain(GROUND, question, answer)
    assert about.proposed.tolist() == [0.0, 0.0] and about.sentence.endswith("verified before: why not")


SLEW = [  # proposed, before, executed, which limits
    ((0.5, 0.0, 0.0), (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), ""),
    ((4.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.8, 0.0, 0.0), "slew-limited"),
    ((9.0, 0.0, 0.0), (4.9, 0.0, 0.0), (5.0, 0.0, 0.0), "clipped to its bounds"),
    ((9.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.8, 0.0, 0.0), "clipped to its bounds, slew-limited"),
    ((4.0, 0.0, 0.0), (), (0.8, 0.0, 0.0), "slew-limited"),
    ((4.0, 0.0, 0.0), (3.9, 0.0, 0.0), (3.95, 0.0, 0.0), "limited by the robot"),
]


@pytest.mark.parametrize(("proposed", "before", "executed", "limited"), SLEW)
def test_a_changed_input_never_stands_beside_a_bare_allowed(proposed, before, executed, limited):
    decision = answered(QUADROTOR, pb.ALLOWED, executed, by="")
    request = asked(QUADROTOR, proposed)
    request.input_in_force[:] = before
    exchange = pb.Exchange(request=request, reply=pb.Reply(decision=decision))
    assert explain(QUADROTOR, request, decision).limited == limited
    assert decision_view(QUADROTOR, exchange).explanation_json()["limited"] == limited
    step = pb.Step(state=request.state, proposed=proposed, action=executed, decision=pb.ALLOWED)
    episode = EpisodeRecord("", 0, None, actor_exchanges=[exchange])
    episode.add(step)
    (row,) = rows(episode, QUADROTOR)
    assert row["limited"] == limited


def test_other_decisions_say_themselves_what_changed():
    decision = answered(QUADROTOR, pb.ADJUSTED, (0.8, 0.0, 0.0), normal=(1, 0, 0))
    assert explain(QUADROTOR, asked(QUADROTOR, (4.0, 0.0, 0.0)), decision).limited == ""
