"""Tests of many robots at once against one robot that drives alone."""

import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.batch_robots import BatchRobots
from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging.task import robot_with_task

QUADROTOR = robot_with_task("quadrotor")


def test_without_a_filter_the_batch_records_what_the_vehicle_executed() -> None:
    """The vehicle limits how fast its input changes. A learner needs the limited input, not the proposed one."""
    batch = BatchRobots(QUADROTOR, ["a"], None, lambda robot: (0, 0), seed_key=1_000_000)
    alone = EpisodeRunner(
        QUADROTOR, environment(QUADROTOR, "default", 1_000_000), ActorIdentity("a", 0, 0), filtered=False
    )
    alone.begin(0)
    for proposal in ([5.0, -5.0, 2.0], [5.0, -5.0, 2.0], [np.nan, 0.5, 0.5], [0.5, np.inf, 0.5], [0.1, 0.2, 0.3]):
        batch.begin_period(np.array([proposal]))
        [step], _ = batch.end_period()
        expected = alone.execute(np.array(proposal), None)
        assert list(step.action) == pytest.approx(list(expected.action), abs=1e-12)
        assert list(step.proposed) == pytest.approx(list(expected.proposed), abs=1e-12)
    batch.close()
