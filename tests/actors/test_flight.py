"""Before a flight: a vehicle stays on the ground where not even hovering can be verified."""

import pytest

from actors.flight import NoRoom, answered
from deploy.data.store import model_for
from deploy.study.evaluate import in_process
from messaging.shapes import Obstacle
from safety.recipe import Recipe
from sim.world import Arena, staged_arena
from tests.robots import QUADROTOR


def stage(gap: float) -> Arena:
    """A sphere so far [m] from the vehicle's own, at the start."""
    radius = 0.4
    away = QUADROTOR.footprint + gap + radius
    return staged_arena(
        Obstacle("sphere", (away, 0.0, 3.0), (radius,)), start=(0.0, 0.0, 3.0), half_width=6.0, height=6.0
    )


@pytest.mark.usefixtures("flight_folder")
def test_it_does_not_take_off_where_it_could_not_hover() -> None:
    robot = QUADROTOR.in_real_time()
    question = in_process(model_for(robot, Recipe()))
    assert answered(question, robot, stage(2.0), True, lambda: False)
    with pytest.raises(NoRoom, match=r"0\.\d+ m from the nearest obstacle.*collect more data"):
        answered(question, robot, stage(0.02), True, lambda: False)
    assert answered(question, robot, stage(0.02), False, lambda: False), "a rival says nothing of hovering"
