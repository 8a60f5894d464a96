"""The score of a window that has ended: how much of its sets the errors used (docs/method.md §15)."""

from __future__ import annotations

from functools import partial

import numpy as np

from brakeline.messaging.robot import Array
from brakeline.safety.filter.widening import PastWindow
from brakeline.safety.model.model_set import ModelSet, scored_coordinates
from brakeline.safety.model.one_step import OneStep


class WindowScore:
    """Scores windows by the sets that a model set of mode one-step states for them, without widening."""

    def __init__(self, model: ModelSet, one_step: OneStep) -> None:
        robot = model.robot
        kappa, M, w = (np.array([getattr(step, name) for step in model.steps]) for name in ("kappa", "M", "w"))
        scored = np.array(scored_coordinates(robot), dtype=np.int64)
        W = np.ascontiguousarray(model.first.W)  # the same for all periods
        from brakeline.safety.filter.kernels import window_kernels

        self._score = partial(window_kernels.score, *one_step.rollout_arguments(robot))
        self._sets = W, M, kappa, w, scored
        self._start = one_step.start

    def __call__(self, past: PastWindow, state: Array) -> tuple[float, float]:
        """Return the largest ratio of an error to its set in the window that ends in a measured state (n,).

        The first number counts all errors, the second only those of `scored_coordinates`.
        """
        states = np.concatenate([past.states, state[None]])
        score, of_plan = self._score(states, np.require(past.inputs, float, ("C", "W")), *self._sets)
        return (score / self._start, of_plan / self._start) if past.from_start else (score, of_plan)
