"""Decide batches by a method that decides one request at a time, such as a rival."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from brakeline.safety.filter.batch.batch_filter import blank_answers, completed
from brakeline.safety.filter.batch.decision_arrays import DecisionArrays
from brakeline.safety.filter.batch.request_arrays import RequestArrays

if TYPE_CHECKING:
    from brakeline.safety.filter.filter import Filter
    from brakeline.safety.methods import Method


STATED: dict[str, Any] = {"bound": None, "judges": False, "outside_share": 0.0}  # without a decision: see `Decision`


class RowByRow:
    """A method that decides on many robots as `Filter` does: one decision after the other.

    >>> from brakeline import Filter, Request, RequestArrays, Shapes
    >>> stand = np.zeros((3, 2))
    >>> request = Request(np.zeros(5), [0.2, 0.0], stand[0], stand, Shapes.of([], dim=2), known_free=True)
    >>> answers = RowByRow(Filter.load("ground")).decide_batch(RequestArrays.of([request] * 3))
    >>> answers.plan[:, 0].tolist()
    [[0.2, 0.0], [0.2, 0.0], [0.2, 0.0]]
    """

    def __init__(self, method: Method) -> None:
        self._method, self.robot, self.version = method, method.robot, method.version
        self.model, self.acceleration_age = getattr(method, "model", None), getattr(method, "acceleration_age", None)

    def decide_batch(self, requests: RequestArrays) -> DecisionArrays:
        """Decide on NumPy arrays. Raises BadRequest: a value is missing, not finite, or has the wrong size."""
        started, every = perf_counter_ns(), np.ones(len(requests), dtype=bool)
        answers = blank_answers(self.robot, requests, np, "cpu")
        all_rows = completed(self._method, requests, answers, every, started, **STATED)
        stated = {name: getattr(one, name) for one in [*all_rows.singly.values()][:1] for name in STATED}
        return replace(all_rows, **stated)  # by one method, so it is the same in every row


BatchMethod: TypeAlias = "Filter | RowByRow"  # what `BackupPlanBatch` asks
