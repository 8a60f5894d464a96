"""What stands between a policy and the cart-pole: nothing, Brakeline, or the authors' predictive safety filter.

A filter takes the state, the proposed force [N] and the environment's `info`, and returns the force to execute.
"""

from __future__ import annotations

import io
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from brakeline import Filter, InProcess, ModelSet
from examples.safe_control_gym.adapter import make, source
from examples.safe_control_gym.velocity_loop import Array, force_of, velocity_of

# The settings of the authors' example, examples/mpsc/config_overrides/cartpole/linear_mpsc_cartpole.yaml.
MPSC: dict[str, Any] = {"horizon": 20, "q_lin": [1, 1, 1, 1], "r_lin": [0.1], "use_terminal_set": False}


class Unfiltered:
    """Executes every proposal."""

    def __init__(self) -> None:
        self.kinds: Counter[str] = Counter()  # the decisions of the episode, by kind
        self.outside = 0  # steps of the episode in which the state left Brakeline's predicted set

    def reset(self) -> None:
        """Begin an episode."""
        self.kinds.clear()
        self.outside = 0

    def __call__(self, state: Array, force: float, info: dict[str, Any]) -> float:
        return force


class Brakeline(Unfiltered):
    """Decides about the commanded velocity that gives the proposed force."""

    def __init__(self, model: Path, accept_bound: float) -> None:
        super().__init__()
        self._safety = InProcess(Filter(ModelSet.load(model)), accept_bound)

    def reset(self) -> None:
        super().reset()
        self._safety.reset()

    def __call__(self, state: Array, force: float, info: dict[str, Any]) -> float:
        answer = self._safety.decide(state, [velocity_of(state, force)])
        self.kinds[answer.kind] += 1
        self.outside += not answer.contained
        return force_of(state, answer.action[0])


class PredictiveSafetyFilter(Unfiltered):
    """The authors' `LINEAR_MPSC` with its settings and its stored set, and IPOPT without output."""

    def __init__(self, disturbed: bool) -> None:
        super().__init__()
        module = predictive_module()
        self._filter = module.LINEAR_MPSC(partial(make, disturbed=disturbed), **MPSC)
        self._filter.reset()
        self._filter.load(source() / "examples/mpsc/models/linear_mpsc_cartpole.pkl")
        quiet = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 50}
        self._filter.opti_dict["opti"].solver("ipopt", {"expand": True, **quiet})

    def reset(self) -> None:
        super().reset()
        self._filter.reset_before_run()

    def __call__(self, state: Array, force: float, info: dict[str, Any]) -> float:
        with redirect_stdout(io.StringIO()):  # it prints every failure of its solver
            certified, success = self._filter.certify_action(state, np.array([force]), info)
        feasible = self._filter.results_dict["feasible"][-1]
        self.kinds["feasible" if feasible else "earlier plan" if success else "uncertified"] += 1
        return float(certified) if success else force  # as the authors' BaseExperiment does


def predictive_module() -> ModuleType:
    """Import the authors' filter without MOSEK and cddlib.

    It needs MOSEK only to compute the set that is stored in its repository, and cddlib only for the difference of two
    boxes.
    """
    for name in ("cvxpy", "pytope"):
        sys.modules.setdefault(name, ModuleType(name))
    sys.modules["pytope"].Polytope = None  # type: ignore[attr-defined]
    from safe_control_gym.safety_filters.mpsc import linear_mpsc

    theirs = linear_mpsc.pontryagin_difference_AABB
    linear_mpsc.pontryagin_difference_AABB = lambda a, b: box_difference(a, b) if a.shape[1] > 1 else theirs(a, b)
    return linear_mpsc


def box_difference(corners: Array, others: Array) -> tuple[Array, Callable[..., Any]]:
    """Return the corners of a box minus another box around zero, and the constraint to be within it."""
    from safe_control_gym.envs.constraints import LinearConstraint

    high, low = corners.max(0) - others.max(0), corners.min(0) - others.min(0)
    one = np.eye(len(high))
    return np.stack([low, high]), partial(LinearConstraint, A=np.vstack([one, -one]), b=np.append(high, -low))


FILTERS: dict[str, Callable[[Any], Unfiltered]] = {
    "none": lambda options: Unfiltered(),
    "brakeline": lambda options: Brakeline(options.model, options.accept_bound),
    "mpsc": lambda options: PredictiveSafetyFilter(options.disturbed),
}
