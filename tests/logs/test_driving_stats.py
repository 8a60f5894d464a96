"""Windows by kind of driving, beside what the model set states about each kind."""

import math

import numpy as np
import pytest

from brakeline.logs.driving_stats import CHUNK, DrivingStats
from brakeline.logs.figure_tables import _driving
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.tube_stats import TubeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.model.error_causes import REGIMES
from tests.robots import GROUND

N, n, m = GROUND.horizon, GROUND.state_dim, GROUND.action_dim
FULL = np.asarray(GROUND.high())


def exchange(inputs, score, start=False, model="one", speed=0.0):
    """An exchange whose window has these inputs (N + 1, m), and this forward speed at its beginning."""
    states = np.zeros((N, n))
    states[:, 3] = speed
    request = pb.Request(
        robot="ground", past_states=states.ravel(), past_inputs=np.ravel(inputs), past_from_start=start
    )
    return pb.Exchange(request=request, reply=pb.Reply(decision=pb.Decision(model=model, score=score)))


def held(*shares):
    return np.tile(np.array(shares) * FULL, (N + 1, 1))


JUMPS = held(1.0, 0.2) * np.where(np.arange(N + 1) % 2, 1.0, -1.0)[:, None]
WINDOWS = [
    *[exchange(held(0.0, 0.0), 0.5) for _ in range(5)],  # stands
    *[exchange(held(0.0, 0.0), 1.5, start=True) for _ in range(2)],
    *[exchange(held(1.0, 0.0), 0.2, speed=FULL[0]) for _ in range(4)],  # drives at full speed
    *[exchange(held(0.3, 0.3), 2.5) for _ in range(3)],
    exchange(JUMPS, math.nan),
]
STATED = {"model ground": {"version": "one", "bound_plan standing": "0.01", "bound_plan slow": "nonsense"}}


@pytest.fixture
def stats():
    return DrivingStats(RecordedRobots([GROUND]), STATED)


def test_each_window_counts_in_its_kinds_beside_what_is_stated(stats):
    for one in WINDOWS:
        stats.exchange(one)
    kinds = stats.figures()["ground"]
    assert kinds == stats.figures()["ground"], "and again"
    counts = {kind: (row["windows"], row["outside"]) for kind, row in kinds.items()}
    assert counts == {
        "start of an episode": (2, 2),
        "standing": (7, 2),
        "slow": (3, 3),
        "fast": (5, 1),
        "speed at its bound": (5, 1),
        "jumping inputs": (1, 1),
    }
    assert kinds["slow"]["excess"] == 2.5 and kinds["jumping inputs"]["excess"] == math.inf
    assert {kind for kind, row in kinds.items() if row["bound"] is not None} == {"standing"}
    assert kinds["standing"]["bound"] == 0.01
    columns = [list(map(str, column.cells)) for column in _driving("ground", kinds).columns]
    assert [cells[columns[0].index("standing")] for cells in columns] == ["standing", "7", "2 (28.57%)", "≤ 1 %"]
    assert [cells[columns[0].index("fast")] for cells in columns] == ["fast", "5", "1 (20.00%)", "–"]


def test_its_regimes_add_up_to_the_windows_of_all_plans(stats):
    plans, rounds = TubeStats(), CHUNK // len(WINDOWS) + 2
    for _ in range(rounds):
        for one in WINDOWS:
            stats.exchange(one)
            plans.exchange(one)
    rows = [row for kind, row in stats.figures()["ground"].items() if kind in REGIMES]
    assert sum(row["windows"] for row in rows) == plans.scored == rounds * len(WINDOWS) > CHUNK
    assert sum(row["outside"] for row in rows) == plans.beyond == rounds * 6


def test_a_window_that_another_model_set_scored_has_no_statement(stats):
    stats.exchange(WINDOWS[0])
    stats.exchange(exchange(held(0.0, 0.0), 0.5, model="another"))
    assert stats.figures()["ground"]["standing"]["bound"] is None


@pytest.mark.parametrize("part", ["past_states", "past_inputs"])
def test_what_is_no_window_does_not_count(stats, part):
    for values in ([], [0.0], [math.nan] * len(getattr(WINDOWS[0].request, part))):
        wrong = pb.Exchange.FromString(WINDOWS[0].SerializeToString())
        del getattr(wrong.request, part)[:]
        getattr(wrong.request, part).extend(values)
        stats.exchange(wrong)
    unscored = pb.Exchange.FromString(WINDOWS[0].SerializeToString())
    unscored.reply.decision.ClearField("score")
    stats.exchange(unscored)
    unknown = pb.Exchange.FromString(WINDOWS[0].SerializeToString())
    unknown.request.robot = "nobody"
    stats.exchange(unknown)
    assert stats.figures() == {}
