"""A Gymnasium wrapper that puts the batch filter in front of many simulated robots, all as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from brakeline.errors import Mismatch
from brakeline.messaging.number_checks import check_numbers
from brakeline.safety.environment_views import copied
from brakeline.safety.filter.batch.obstacle_arrays import ObstacleArrays
from brakeline.safety.filter.batch.plan_batch import BackupPlanBatch, BatchOutcome, correction_penalties
from brakeline.safety.gym_checks import age_of_acceleration, check_robot, check_rows

if TYPE_CHECKING:
    from brakeline.safety.filter.batch.row_by_row import BatchMethod

Array = NDArray[np.float64]
StepBatch = tuple[Any, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class BatchSafetyWrapper(VectorWrapper):
    """Replaces the actions of N robots by the filter's decisions on them, and subtracts penalties from the rewards.

    The environment gives `infos["state"]` (N, n) and `infos["obstacles"]`, a dict of the arrays of `ObstacleArrays`,
    and the methods `begin_step(inputs)` and `end_step()` as `brakeline.sim.batch.batch_env.BatchNavigationEnv` does.
    `VectorSafetyWrapper` takes every other environment. Put other wrappers around this one, not inside it.

    `step` adds to `infos`: `outcome` (a `BatchOutcome`), `executed` (N, m), `penalty` (N,), and `compared` and
    `contained` (N,): whether the filter predicted the new state, and whether the state is in that set.
    Gymnasium's `DictInfoToList` takes none of these infos, since `outcome` is not an array.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: BatchMethod,
        penalty: float = 0.0,
        accept_bound: float | None = None,
        turn_aside: bool = False,
        acceleration_age: float | None = None,
    ) -> None:
        """Wrap an environment; see `SafetyWrapper` for the arguments. `RowByRow` makes a filter of a rival.

        Raises:
            Mismatch: the environment has no `begin_step` and `end_step`, or other wrappers around it, or the filter is
                that of another robot.
            TooLoose: the validation report states a larger probability than accepted, or there is no report.
            TypeError: `filter` is a client, or decides on one robot at a time.
            ValueError: batches do not decide for this kind of robot, or the penalty is negative or not finite.
        """
        from brakeline.safety.model.stated_bound import check_bound

        if not hasattr(env.unwrapped, "begin_step"):
            raise Mismatch(f"{env} has no begin_step and end_step: give it to VectorSafetyWrapper")
        if env is not env.unwrapped:
            raise Mismatch(
                f"BatchSafetyWrapper steps {env.unwrapped} itself, past {env}: put it inside all other wrappers"
            )
        if not hasattr(filter, "decide_batch"):
            name = type(filter).__name__
            if hasattr(filter, "observed"):  # a rival: clients have no such attribute
                raise TypeError(f"a {name} decides on one robot at a time: give RowByRow of it")
            raise TypeError(f"a filter is needed here, not a {name}: give Filter.load(NAME_OR_PATH)")
        super().__init__(env)
        check_robot(env, filter.robot)
        check_bound(getattr(filter, "model", None), filter.robot, accept_bound)
        self.plans, self.penalty = BackupPlanBatch(filter, env.num_envs, turn_aside), penalty
        check_numbers(self, "penalty", least=0.0)
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._acceleration_age = acceleration_age
        self._infos: dict[str, Any] | None = None
        self._observations: Any = None
        self._ended = np.zeros(env.num_envs, dtype=bool)
        self._deciding: tuple[Array, Array, BatchOutcome] | None = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        mask = (options or {}).get("reset_mask")
        which = np.ones(self.num_envs, dtype=bool) if mask is None else np.array(mask, dtype=bool)
        # Some environments take the mask out of the options that they get.
        options = None if options is None else dict(options)
        observations, infos = self.env.reset(seed=seed, options=options)
        self.plans.acceleration_age = age_of_acceleration(infos, self._acceleration_age, 0.0, self.plans.safety)
        self._keep(observations, infos)
        self.plans.reset(which)
        self._ended = self._ended & ~which
        return observations, infos

    def _keep(self, observations: Any, infos: dict[str, Any]) -> None:
        """Keep what the next requests are about, as copies.

        A policy may overwrite what it gets, and the next reset overwrites the obstacles, which decisions refer to.
        """
        own = {"state": infos["state"].copy(), "obstacles": {n: part.copy() for n, part in infos["obstacles"].items()}}
        self._infos, self._observations = infos | own, copied(observations)

    def step(self, actions: Any) -> StepBatch:
        self.begin_step(actions)
        return self.end_step()

    def begin_step(self, actions: Any) -> BatchOutcome:
        """Decide on the actions (N, m), and start the period in a thread of the environment."""
        if self._infos is None:
            raise gymnasium.error.ResetNeeded("reset the environment before the first step")
        if self._deciding is not None:
            raise gymnasium.error.AlreadyPendingCallError("a period is under way: call end_step first", "begin_step")
        proposed, before = (
            np.array(actions, dtype=float),
            self.plans.input_in_force,
        )  # `actions` may be overwritten
        check_rows(proposed, self.num_envs, self.plans.robot)
        obstacles = ObstacleArrays(**self._infos["obstacles"])
        outcome = self.plans.decide(self._infos["state"], proposed, obstacles, self._observations)
        self.env.unwrapped.begin_step(outcome.inputs.copy())  # type: ignore[attr-defined]
        self._deciding = proposed, before, outcome
        return outcome

    def end_step(self) -> StepBatch:
        """Wait for the period that `begin_step` started, and return what `step` returns."""
        assert self._deciding is not None, "begin_step comes first"
        (proposed, before, outcome), self._deciding = self._deciding, None
        observations, rewards, terminated, truncated, infos = self.env.unwrapped.end_step()  # type: ignore[attr-defined]
        # In the mode NEXT_STEP, an environment that has ended is reset and takes no action.
        resets = self._ended if self._mode == AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, dtype=bool)
        penalty = correction_penalties(self.plans.robot, proposed, before, outcome.inputs, self.penalty)
        penalty[resets] = 0.0
        after = infos.get("final_info", infos)["state"]
        infos = infos | {
            "outcome": outcome,
            "executed": outcome.inputs,
            "penalty": penalty,
            "compared": self.plans.predicted.given & ~resets,
            "contained": self.plans.contains(after),
        }
        self._ended = terminated | truncated
        if self._mode != AutoresetMode.DISABLED:
            self.plans.reset(self._ended if self._mode == AutoresetMode.SAME_STEP else resets)
        self._keep(observations, infos)
        return observations, rewards - penalty, terminated, truncated, infos
