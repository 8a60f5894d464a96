"""Steps that nobody would have published who was taken in."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadStep
from brakeline.learner.learner import AHEAD, MOST_ACTORS, Learner
from brakeline.learner.transition_reader import MOST_OBSERVED, StepReader
from brakeline.messaging import brakeline_pb2 as pb
from tests.learner.test_core import step
from tests.learner.toy import CONFIG, TOY


@pytest.fixture
def learner() -> Learner:
    learner = Learner(TOY, replace(CONFIG, lockstep=False))
    learner.join(pb.Join(robot="toy", actor="actor-0", layout=TOY.learning_layout()))
    return learner


def test_steps_of_an_actor_that_never_joined_are_refused_and_counted(learner: Learner) -> None:
    for number in range(1, 1501):
        with pytest.raises(BadStep, match="never joined"):
            learner.insert(step(number, actor="stranger", reward=1.0))
    assert (learner.steps, learner.rejected, len(learner._replay)) == (0, 1500, 0)
    assert "stranger" not in learner.flow().limit
    assert learner.insert(step(1))


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        *(({"reward": value}, "reward") for value in (1e6, -1e6, StepReader(TOY).most_reward * 1.01, np.inf, np.nan)),
        *(({"penalty": value}, "reward") for value in (1e6, -0.1, np.inf, np.nan)),
        *(({"observation": [value, 0.0]}, "observation") for value in (MOST_OBSERVED * 1.01, -1e30, np.nan)),
        *(({"next_observation": [0.0, value]}, "next_observation") for value in (1e30, -np.inf)),
        *(({"action": [value], "proposed": [1.0]}, "action") for value in (2.1, -0.1, 1e30, np.nan)),
        *(({"proposed": [value], "action": [1.0]}, "proposed") for value in (1e30, -np.inf)),
        *(({name: 2**32 - 1}, "episode") for name in ("episode", "step")),
        *(({"index": index}, "index") for index in (10**9, 2**64 - 1, AHEAD + 1 + CONFIG.window)),
    ],
)
def test_what_is_out_of_the_tasks_bounds_is_refused(learner: Learner, fields: dict, field: str) -> None:
    learner.flow()
    with pytest.raises(BadStep) as refused:
        learner.insert(step(1, **fields))
    assert refused.value.field == field
    assert learner.rejected == 1 and learner.steps == 0
    assert learner.insert(step(1)) and learner.metrics().missing == 0


def test_proposals_out_of_bounds_are_clipped_as_ever(learner: Learner) -> None:
    assert learner.insert(step(1, proposed=[3.0], action=[2.0]))


@pytest.mark.parametrize("place", [{"index": 2**64 - 1}, {"episode": 2**32 - 1}])
def test_an_actor_that_comes_from_nowhere_is_refused(learner: Learner, place: dict) -> None:
    join = pb.Join(robot="toy", actor="far", layout=TOY.learning_layout(), **place)
    assert learner.join(join).error.field == "index"
    assert "far" not in learner.flow().limit


def test_there_is_an_end_of_actors(learner: Learner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.learner.learner.MOST_ACTORS", 10)
    assert MOST_ACTORS > 1000
    errors = [
        learner.join(pb.Join(robot="toy", actor=f"a{n}", layout=TOY.learning_layout())).error.field for n in range(12)
    ]
    assert errors == [""] * 9 + ["actor"] * 3
    again = pb.Join(robot="toy", actor="a0", layout=TOY.learning_layout())
    assert not learner.join(again).HasField("error"), "who is in may come again"
