"""Turn the steps of each actor into n-step transitions.

A window opens at every step. It closes after n steps, at the end of the episode, or before a missing step. Only a
*terminated* episode has no value after its end. After truncation or a gap, the value is γ^k Q(s') of the last state.

A step that the safety filter corrected gives two transitions with `Stored` "both": the executed action without the
penalty, and the proposed action with it. With "executed", the executed action has the penalty. The learner then learns
nothing about actions that the filter never allows, and the critic's guesses draw the policy to the obstacles.

The executed action of a corrected step that has a penalty is marked as one that the actor may imitate.

A *cut* step (an intervention of SAILR) ends the episode for the learner only. The proposed action gets the lowest
reward and no value after it (the absorbing MDP of Wagener et al. 2021, section 4). With "both", the action of the
backup policy is a one-step transition with a value after it.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from brakeline.learner.checkpoint import PartState
from brakeline.learner.learner_config import Stored
from brakeline.learner.replay import Transition, Vector

VECTORS = ("observation", "action", "proposed", "next_observation")


class ActorStep(NamedTuple):
    """One step of one episode of an actor."""

    episode: int
    step: int
    observation: Vector
    action: Vector  # executed
    proposed: Vector
    reward: float  # without the penalty
    penalty: float
    next_observation: Vector
    terminated: bool
    truncated: bool
    cut: bool = False  # the episode ends for the learner; reward − penalty is the lowest possible
    collision: bool = False  # also with what moves, by the robot's own fault


class NStepWindows:
    """The open windows of each actor: at most n − 1 consecutive steps."""

    def __init__(self, n: int, gamma: float, stored: Stored = "executed") -> None:
        self.n, self.gamma, self.stored = n, gamma, stored
        self._open: dict[str, deque[ActorStep]] = {}
        self._last: dict[str, tuple[int, int]] = {}  # newest (episode, step) of an actor

    def push(self, actor: str, move: ActorStep) -> list[Transition]:
        """Return the transitions that a step completes, oldest first. The step is no duplicate (`StepLedger`)."""
        here, last = (move.episode, move.step), self._last.get(actor, (-1, -1))
        if here < last:  # it comes late: the windows of its neighbours are closed
            return self._close([move])
        self._last[actor] = here
        moves = self._open.setdefault(actor, deque())
        done: list[Transition] = []
        if here != (last[0], last[1] + 1):
            done += self._drain(moves)
        moves.append(move)
        if move.terminated or move.truncated or move.cut:
            done += self._drain(moves)
        elif len(moves) == self.n:
            done += self._close(moves)
            moves.popleft()
        return done

    def _drain(self, moves: deque[ActorStep]) -> list[Transition]:
        done: list[Transition] = []
        while moves:
            done += self._close(moves)
            moves.popleft()
        return done

    def _close(self, moves: deque[ActorStep] | list[ActorStep]) -> list[Transition]:
        first, last = moves[0], moves[-1]
        if first.cut:
            return self._cut(first)
        reward = cost = penalty = 0.0
        for move in reversed(moves):
            reward = move.reward + self.gamma * reward
            cost = move.collision + self.gamma * cost
            penalty = move.penalty + self.gamma * penalty
        discount = 0.0 if last.terminated or last.cut else self.gamma ** len(moves)
        end, corrected = (reward, discount, last.next_observation, cost), float(first.penalty > 0.0)
        if self.stored == "executed" or np.array_equal(first.action, first.proposed):
            return [Transition(first.observation, first.action, *end, penalty, corrected)]
        return [
            Transition(first.observation, first.action, *end, penalty - first.penalty, corrected),
            Transition(first.observation, first.proposed, *end, penalty),
        ]

    def _cut(self, move: ActorStep) -> list[Transition]:
        seen, after = move.observation, move.next_observation
        done = [Transition(seen, move.proposed, move.reward - move.penalty, 0.0, after)]
        if self.stored == "both" and not np.array_equal(move.action, move.proposed):
            discount = 0.0 if move.terminated else self.gamma
            done.insert(0, Transition(seen, move.action, move.reward, discount, after))
        return done

    def state(self) -> PartState:
        """Return the state for a checkpoint, with the open windows: other actors may be within an episode."""
        actors = sorted(self._last)
        moves = [(number, move) for number, actor in enumerate(actors) for move in self._open[actor]]
        tensors = {
            "place": np.array([(n, m.episode, m.step) for n, m in moves], np.int64).reshape(len(moves), 3),
            "reward": np.array([(m.reward, m.penalty) for _, m in moves], np.float64).reshape(len(moves), 2),
        }
        for name in VECTORS:
            rows = [getattr(move, name) for _, move in moves]
            tensors[name] = np.array(rows, np.float32) if rows else np.zeros((0, 0), np.float32)
        return PartState(tensors, {"actors": actors, "last": [list(self._last[actor]) for actor in actors]})

    def restore(self, state: PartState) -> None:
        """Take over the state of a checkpoint."""
        actors: list[str] = state.value("actors")
        self._last = {actor: (last[0], last[1]) for actor, last in zip(actors, state.value("last"), strict=True)}
        self._open = {actor: deque() for actor in actors}
        place = state.tensor("place", (None, 3), "int64")
        rewards = state.tensor("reward", (len(place), 2), "float64")
        vectors = [state.tensor(name, (len(place), None), "float32") for name in VECTORS]
        for (number, episode, step), (reward, penalty), *parts in zip(place, rewards, *vectors, strict=True):
            observation, action, proposed, after = parts
            places, values = (int(episode), int(step)), (float(reward), float(penalty))
            move = ActorStep(*places, observation, action, proposed, *values, after, False, False)
            self._open[actors[number]].append(move)
