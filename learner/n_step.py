"""From single steps to n-step transitions, per actor.

A window opens at every step and closes after n steps or, shorter, where the episode ends or a step is missing. Only a
*terminated* episode has no value beyond its end; truncation and gaps leave one, γ^k Q(s'), with s' as last seen. So
nothing spans a gap and nothing that arrived is lost.

A step that the safety filter corrected is two lessons in one: proposing what was executed would have had the same
outcome without a penalty, and proposing what was proposed had it with one. With `Stored` "both" each becomes a
transition. "executed" alone teaches nothing about actions that the filter never lets pass, and the critic's guesses
about them draw the policy to the obstacles; there the penalty stands with the executed action.

A step that is *cut* (SAILR's intervention) ends the episode for the learner alone: proposing what was proposed leads to
nothing, with the lowest reward (Wagener et al. 2021, section 4: the absorbing MDP). With "both" what the backup policy
did instead is a transition of its own, of one step, with a value beyond it.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from brakeline.learner.checkpoint_state import PartState
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
    cut: bool = False  # for the learner the episode ends here; the reward less the penalty is the lowest there is


class NStepWindows:
    """Open windows of every actor: at most n − 1 consecutive moves each."""

    def __init__(self, n: int, gamma: float, stored: Stored = "executed") -> None:
        self.n, self.gamma, self.stored = n, gamma, stored
        self._open: dict[str, deque[ActorStep]] = {}
        self._last: dict[str, tuple[int, int]] = {}  # newest (episode, step) of an actor

    def push(self, actor: str, move: ActorStep) -> list[Transition]:
        """The transitions that this move completes, oldest first. Moves are not repeated (`learner/step_ledger.py`)."""
        here, last = (move.episode, move.step), self._last.get(actor, (-1, -1))
        if here < last:  # a straggler: its neighbours are closed, it stands for itself
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
        reward = 0.0
        for move in reversed(moves):
            reward = move.reward - move.penalty + self.gamma * reward
        discount = 0.0 if last.terminated or last.cut else self.gamma ** len(moves)
        if first.cut:
            return self._cut(first)
        if self.stored == "executed" or np.array_equal(first.action, first.proposed):
            return [Transition(first.observation, first.action, reward, discount, last.next_observation)]
        return [
            Transition(first.observation, first.action, reward + first.penalty, discount, last.next_observation),
            Transition(first.observation, first.proposed, reward, discount, last.next_observation),
        ]

    def _cut(self, move: ActorStep) -> list[Transition]:
        seen, after = move.observation, move.next_observation
        done = [Transition(seen, move.proposed, move.reward - move.penalty, 0.0, after)]
        if self.stored == "both" and not np.array_equal(move.action, move.proposed):
            discount = 0.0 if move.terminated else self.gamma
            done.insert(0, Transition(seen, move.action, move.reward, discount, after))
        return done

    def state(self) -> PartState:
        """The open windows too: with several actors a checkpoint cuts through the episodes of all but one."""
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
