"""An intervention ends the episode for the learner, and for nobody else."""

import numpy as np
import pytest

from brakeline.learner.n_step import ActorStep, NStepWindows
from brakeline.learner.transition_reader import StepReader
from brakeline.messaging import brakeline_pb2 as pb
from tests.robots import GROUND

GAMMA = 0.9
LOWEST = -100.0


def move(step: int, cut: bool = False, terminated: bool = False) -> ActorStep:
    here, after = np.array([step], np.float32), np.array([step + 1], np.float32)
    action, proposed = np.array([0.0 if cut else 0.5], np.float32), np.array([0.5], np.float32)
    return ActorStep(0, step, here, action, proposed, 1.0, 1.0 - LOWEST if cut else 0.0, after, terminated, False, cut)


def learned(stored: str, n: int = 3, cut_at: int = 2, steps: int = 5, **more) -> list[tuple]:
    windows = NStepWindows(n, GAMMA, stored)
    found = [t for k in range(steps) for t in windows.push("a", move(k, k == cut_at, **(more if k == cut_at else {})))]
    return [
        (
            int(t.observation[0]),
            float(t.action[0]),
            round(t.reward, 6),
            round(t.discount, 6),
            int(t.next_observation[0]),
        )
        for t in found
    ]


def test_the_proposal_led_nowhere_with_the_lowest_reward_and_nothing_spans_it():
    assert learned("executed") == [
        (0, 0.5, pytest.approx(1 + 0.9 + 0.81 * LOWEST), 0.0, 3),
        (1, 0.5, pytest.approx(1 + 0.9 * LOWEST), 0.0, 3),
        (2, 0.5, LOWEST, 0.0, 3),
    ], "steps 3 and 4 begin anew and are still open"


def test_what_the_backup_did_is_a_lesson_of_its_own():
    both = learned("both")
    assert both[2:] == [(2, 0.0, 1.0, GAMMA, 3), (2, 0.5, LOWEST, 0.0, 3)]
    assert both[:2] == learned("executed")[:2]


def test_if_the_backup_itself_ends_the_episode_that_has_no_value_beyond():
    assert learned("both", terminated=True, steps=3)[2:] == [(2, 0.0, 1.0, 0.0, 3), (2, 0.5, LOWEST, 0.0, 3)]


def test_the_steps_after_it_are_learned_from():
    assert [row[0] for row in learned("executed", steps=7)] == [0, 1, 2, 3, 4]


def test_the_intake_reads_it_from_the_wire():
    vector = [0.0] * GROUND.task.observation_dim
    step = pb.Step(robot="ground", actor="a", index=1, observation=vector, next_observation=vector)
    step.action.extend([0.0, 0.0])
    step.proposed.extend([0.1, 0.0])
    assert not StepReader(GROUND).move(step).cut
    step.cut = True
    assert StepReader(GROUND).move(step).cut
