"""A robot without a heading keeps off by what it needs to stand where its plan ends, in each direction."""

from functools import cache

import numpy as np

from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.robot import robot_named
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, Request

AIR = robot_named("quadrotor")
FAST = np.array([4.0, 0.0, 0.0])
HOVER = np.zeros(3)


@cache
def ready(clearance_margin=None):
    return Filter(Filter.load("quadrotor").model, clearance_margin)


def asked(state, action, before, obstacles):
    plan = np.vstack([before * share for share in AIR.stop_profile()])
    return Request(state, action, before, plan, Shapes.of(obstacles, 3), known_free=True)


def flying(action, obstacles):
    """A request of a quadrotor that flies fast along x, from the origin."""
    return asked(AIR.state_at_inputs(FAST), np.array(action), FAST, obstacles)


def standing():
    """The tube of hovering: centers (N, 3), directions (N, 3, L), sizes of L generators, and the other sizes."""
    tube = ready().tube
    z = np.concatenate([AIR.state_at_inputs(HOVER)[list(AIR.regressor)], HOVER, np.tile(HOVER, AIR.free_steps)])
    sizes = tube.magnitudes(z)
    return tube.centers(z), tube.directions, sizes[: tube.generators], sizes[tube.generators :]


def margin_towards(normal):
    planes = ready().constraints.planes
    scene = asked(AIR.state_at_inputs(HOVER), HOVER, HOVER, [Obstacle("sphere", tuple(1.5 * normal), (0.2,))])
    z_0 = np.concatenate([scene.state[ready().regressor], HOVER, HOVER])[: ready().builder.known]
    z = ready().inputs.regressors(z_0, HOVER)
    around = ready().constraints.local_map(scene, z_0, ready().builder.reachable(HOVER))
    return ready().constraints.kept_off(planes(around, z), 2 * AIR.horizon + 1)


def test_towards_each_obstacle_a_hover_gets_what_its_sets_need():
    centers, directions, sizes, others = standing()
    rng, margins = np.random.default_rng(0), []
    for way in np.vstack([np.eye(3), rng.normal(size=(20, 3))]):
        normal = way / np.linalg.norm(way)
        kept = margin_towards(normal)
        assert not kept[:-1].any(), "the robot may pass"
        needed = max(
            normal @ centers[k]
            + normal @ directions[k] @ (sizes * np.sign(normal @ directions[k]))
            + (others[-1] if k == AIR.horizon - 1 else others[k + 1])
            for k in range(AIR.horizon)
        )
        assert needed <= kept[-1] + 1e-12 and kept[-1] <= ready().clearance_margin
        margins.append(kept[-1])
    assert max(margins[:3]) < 0.85 * ready().clearance_margin, "along an axis it needs less than across"


def test_it_can_hover_wherever_it_may_stop_beside_a_wall():
    rng, adjusted = np.random.default_rng(0), 0
    for _ in range(60):
        before, action, way = rng.uniform(-4.0, 4.0, 3), rng.uniform(-5.0, 5.0, 3), rng.normal(size=3)
        state, normal = AIR.state_at_inputs(before), way / np.linalg.norm(way)

        def beside(distance, normal=normal):
            return Obstacle("sphere", tuple(normal * (distance + 50.0)), (50.0,))

        room = ready(0.0).decide(asked(state, action, before, [beside(6.0)])).margin
        wall = beside(6.0 - room + rng.uniform(0.0, 0.1))
        decision = ready().decide(asked(state, action, before, [wall]))
        if decision.kind != ADJUSTED or not decision.for_clearance:
            continue
        adjusted += 1
        for _ in range(10):
            there = AIR.state_at_inputs(HOVER)
            there[:3] = decision.tube_center[-1] + rng.uniform(-1.0, 1.0, 3) * decision.tube_half_width[-1]
            assert ready(0.0).decide(asked(there, HOVER, HOVER, [wall])).kind == ALLOWED
    assert adjusted > 10


def test_a_proposal_that_passes_an_obstacle_is_allowed_and_one_that_stops_beside_it_is_not():
    """Both come nearer than the clearance margin."""
    end = ready().decide(flying(FAST, [])).tube_center[-1, 0]
    for way, kinds in ((0.4 * end, {ALLOWED}), (end, {ADJUSTED})):
        near = []
        for aside in np.linspace(0.5, 3.0, 60):
            request = flying(FAST, [Obstacle("cylinder", (way, aside, 0.0), (0.2, 20.0))])
            without = ready(0.0).decide(request)
            if without.kind == ALLOWED and without.margin < 0.5 * margin_towards(np.array([0.0, 1.0, 0.0]))[-1]:
                near.append(ready().decide(request))
        assert near and {decision.kind for decision in near} == kinds
        assert all(decision.for_clearance for decision in near if decision.kind == ADJUSTED)
