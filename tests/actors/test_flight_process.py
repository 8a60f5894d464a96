"""Where not even hovering can be verified: a vehicle stays on the ground, and gets out of there in the air."""

import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.actors.flight_process import takeoff_verified
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.errors import TakeoffNotVerified
from brakeline.messaging.obstacle import Obstacle
from brakeline.safety.model.model_config import ModelConfig
from brakeline.sim.arena import Arena
from brakeline.sim.delayed_vehicle import delayed
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from tests.accepting import BOUND
from tests.arenas import staged_arena
from tests.robots import QUADROTOR


def stage(gap: float) -> Arena:
    """Return an arena with a sphere whose distance from the body is `gap` [m] at the start."""
    radius = 0.4
    away = QUADROTOR.footprint + gap + radius
    return staged_arena(
        Obstacle("sphere", (away, 0.0, 3.0), (radius,)),
        start=(0.0, 0.0, 3.0),
        goal=(-4.0, -4.0, 3.0),
        half_width=6.0,
        height=6.0,
    )


@pytest.mark.usefixtures("flight_folder")
def test_no_takeoff_where_hovering_cannot_be_verified() -> None:
    robot = QUADROTOR.in_real_time()
    question = in_process(model_for(robot, ModelConfig(), BOUND), BOUND)
    assert takeoff_verified(question, robot, stage(2.0), True, lambda: False)
    with pytest.raises(TakeoffNotVerified, match=r"0\.\d+ m from the nearest obstacle.*collect more data"):
        takeoff_verified(question, robot, stage(0.02), True, lambda: False)
    assert takeoff_verified(question, robot, stage(0.02), False, lambda: False), "a rival method cannot verify hovering"


@pytest.mark.usefixtures("flight_folder")
def test_in_real_time_recovery_continues_period_after_period() -> None:
    """A recovery in every other period would not move a real vehicle: it does not follow so short a command."""
    robot = QUADROTOR.in_real_time()
    question = in_process(model_for(robot, ModelConfig(), BOUND), BOUND)
    make = delayed(Quadrotor, robot)
    env = NavigationEnv(
        robot, "default", make, draw=lambda *_: staged_arena(start=(0.0, 0.0, 3.0), goal=(-4.0, -4.0, 3.0), height=6.0)
    )
    runner = EpisodeRunner(robot, env, ActorIdentity("actor", 0, 0))
    runner.begin(0)
    kinds = []
    for _ in range(25):
        runner.info["obstacles"] = (Obstacle("sphere", (0.5, 0.0, 3.0), (0.6,)),)  # a virtual one around the vehicle
        outcome = runner.decide(np.zeros(3), question)
        assert outcome is not None and outcome.answer is not None
        kinds.append(outcome.answer.kind)
        runner.execute(np.zeros(3), outcome)
    on_the_way = kinds[: len(kinds) - kinds[::-1].index("recovering")]
    assert set(on_the_way) == {"recovering"} and len(on_the_way) >= 2 and kinds[-1] == "allowed", kinds
