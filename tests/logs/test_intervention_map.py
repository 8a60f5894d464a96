"""The map of interventions has the robot in the middle, whatever the arena is and wherever the robot looks."""

import math

import pytest

from brakeline.logs.intervention_map import MOST_CELLS, InterventionMap
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot
from tests.robots import GROUND, QUADROTOR


def intervened(
    robot: Robot, at: list[float], state: list[float], action: list[float], kind: pb.Kind.ValueType = pb.ADJUSTED
) -> pb.Exchange:
    """Return the exchange of an intervention because of an obstacle at this place."""
    decision = pb.Decision(kind=kind, stopped=pb.Stopped(by="box", at=at))
    state = state + [0.0] * (robot.state_dim - len(state))
    return pb.Exchange(request=pb.Request(state=state, action=action), reply=pb.Reply(decision=decision))


@pytest.mark.parametrize("turn", [0.0, 1.0, math.pi, -2.5])
@pytest.mark.parametrize("where", [(0.0, 0.0), (3.0, -7.0)])
def test_an_obstacle_ahead_is_ahead_wherever_the_robot_is_and_looks(where: tuple[float, float], turn: float) -> None:
    grid, ahead, left = InterventionMap(GROUND), 0.44, 0.13
    x, y = where
    at = [x + ahead * math.cos(turn) - left * math.sin(turn), y + ahead * math.sin(turn) + left * math.cos(turn)]
    grid.exchange(intervened(GROUND, at, [x, y, turn], [0.1, 0.0]))
    assert grid.figures()["cells"] == [[int(ahead / grid.cell), int(left / grid.cell), 1, 0, 0]]


def test_a_robot_without_a_heading_looks_where_it_wants_to_go() -> None:
    grid = InterventionMap(QUADROTOR)
    grid.exchange(intervened(QUADROTOR, [0.95, 3.13, 2.0], [1.0, 1.0, 2.0], [0.0, 4.0, 0.0], pb.FAILSAFE))
    assert grid.figures()["cells"] == [[28, 0, 0, 1, 0]]
    assert not grid.figures()["heading"]


def test_what_has_no_place_is_counted_and_what_is_allowed_is_not() -> None:
    grid = InterventionMap(GROUND)
    grid.exchange(intervened(GROUND, [], [0.0] * 3, [0.1, 0.0]))
    grid.exchange(intervened(GROUND, [math.nan, 0.0], [0.0] * 3, [0.1, 0.0]))
    grid.exchange(intervened(GROUND, [1.0, 0.0], [0.0] * 3, [0.1, 0.0], pb.ALLOWED))
    assert grid.figures()["cells"] == [] and grid.elsewhere == 2


def test_cells_become_wider_instead_of_more() -> None:
    grid = InterventionMap(GROUND)
    for k in range(15_000):
        grid.exchange(intervened(GROUND, [k % 150 * 0.1, k // 150 * 0.1], [0.0] * 3, [0.1, 0.0]))
    assert len(grid.cells) <= MOST_CELLS and sum(cell[2] for cell in grid.figures()["cells"]) == 15_000
