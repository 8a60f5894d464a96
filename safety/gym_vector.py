"""A Gymnasium wrapper that puts the filter in front of a vector of environments: one call decides for all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from brakeline.errors import BadRequest, Mismatch
from brakeline.messaging.number_checks import check_numbers
from brakeline.messaging.robot import Array
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.action_mapping import ActionMapping, action_for, mapping_for_space
from brakeline.safety.environment_views import OBSTACLES, STATE, View, copied
from brakeline.safety.filter.backup_plan import BackupPlan, correction_penalty
from brakeline.safety.filter.request import Request
from brakeline.safety.gym import diagnostics, is_measurement_fault
from brakeline.safety.gym_checks import age_of_acceleration, check_robot, check_rows
from brakeline.safety.perception.image_memory import filled, memory_of
from brakeline.safety.service.filter_client import Answer, obstacle_lists
from brakeline.safety.service.in_process import InProcess, request_observation

if TYPE_CHECKING:
    from brakeline.safety.methods import Method


class VectorSafetyWrapper(VectorWrapper):
    """`SafetyWrapper` for a `gymnasium.vector` environment with k environments, in any autoreset mode.

    The arguments are those of `SafetyWrapper` for k environments: `state(env, observations, infos)` returns (k, n),
    `obstacles` returns k lists, and `actions` maps (k, m). `step` adds to `infos`: `safety` (k answers; None for an
    environment that is reset in this step, or whose state is missing or not usable), `penalty` (k,) and `diagnostics`
    (a dict of arrays with k rows; in the row of a reset environment, `proposed` and `executed` have no meaning).
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        filter: Method,
        penalty: float = 0.0,
        *,
        state: View = STATE,
        obstacles: View = OBSTACLES,
        actions: ActionMapping | None = None,
        accept_bound: float | None = None,
        turn_aside: bool = False,
        acceleration_age: float | None = None,
    ) -> None:
        """Wrap a vector environment; see `SafetyWrapper` for the arguments.

        Raises:
            Mismatch, TooLoose, ValueError: see `SafetyWrapper`.
            TypeError: `filter` is a client, which has the backup plan of one robot.
        """
        super().__init__(env)
        self.client, self.penalty = InProcess(filter, accept_bound), penalty
        check_robot(env.unwrapped.envs[0] if isinstance(env.unwrapped, SyncVectorEnv) else env, filter.robot)
        check_numbers(self, "penalty", least=0.0)
        self.backup_plans = [BackupPlan(filter.robot, turn_aside) for _ in range(env.num_envs)]
        self._state, self._obstacles, self._acceleration_age = state, obstacles, acceleration_age
        self._actions = mapping_for_space(env.single_action_space, filter.robot, actions)
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._ended = np.zeros(env.num_envs, dtype=bool)
        self._now: tuple[Any, dict[str, Any]] | None = None
        self._memories = [memory_of(filter.robot) for _ in range(env.num_envs)]
        self._scans: list[RangeMeasurement | None] = [None] * env.num_envs

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        which = np.array((options or {}).get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        # Gymnasium takes the mask out of the options that it gets.
        observations, infos = self.env.reset(seed=seed, options=None if options is None else dict(options))
        age = age_of_acceleration(infos, self._acceleration_age, 0.0, self.client.method)
        for backup_plan in self.backup_plans:
            backup_plan.acceleration_age = age
        if self._now is not None:
            infos = with_earlier_rows(infos, self._now[1], ~which)
        self._now = copied((observations, infos))
        self._begin(which)
        self._remember(infos, which)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        if self._now is None:
            raise gymnasium.error.ResetNeeded("reset the environment before the first step")
        robot = self.client.robot
        proposed = np.array(self._actions.action_to_control(actions), dtype=float)  # `actions` may be overwritten
        check_rows(proposed, self.num_envs, robot)
        # In the mode NEXT_STEP, an environment that has ended is reset and takes no action.
        resets = self._ended if self._mode == AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, dtype=bool)
        deciding = np.flatnonzero(~resets).tolist()
        before = np.array([plan.next_input for plan in self.backup_plans])
        answers, faults = self._decide(deciding, proposed)
        executed = np.array([plan.next_input for plan in self.backup_plans])
        executed[resets] = robot.zero_input()
        space = self.env.action_space
        safe_actions = np.asarray(action_for(executed, self._actions, space), dtype=space.dtype).reshape(space.shape)
        observations, rewards, terminated, truncated, infos = self.env.step(safe_actions)
        penalty = np.zeros(self.num_envs)
        for i in deciding:
            penalty[i] = correction_penalty(robot, proposed[i], before[i], executed[i], self.penalty)
        self._ended = np.asarray(terminated | truncated)
        self._begin(self._ended if self._mode == AutoresetMode.SAME_STEP else resets)
        self._remember(infos, np.ones(self.num_envs, dtype=bool))
        safety = np.array([answers.get(i) for i in range(self.num_envs)], dtype=object)
        figures = [diagnostics(answer, faults.get(i, "reset")) for i, answer in enumerate(safety)]
        infos = infos | {
            "safety": safety,
            "penalty": penalty,
            "diagnostics": {name: np.array([row[name] for row in figures]) for name in figures[0]}
            | {"proposed": proposed, "executed": executed},
        }
        self._now = copied((observations, infos))
        return observations, np.asarray(rewards) - penalty, terminated, truncated, infos

    def _decide(self, deciding: list[int], proposed: Array) -> tuple[dict[int, Answer], dict[int, str]]:
        """Return the decisions on some environments, and the reasons of those without one.

        An environment with a decision commits to it. One without continues its backup plan.
        """
        states, near = self._views()
        assert self._now is not None
        vectors = self._now[0] if isinstance(self._now[0], np.ndarray) else [None] * self.num_envs

        def request(i: int) -> Request:
            return self.client.request(
                self.backup_plans[i],
                states[i],
                proposed[i],
                near[i],
                scan=self._scans[i],
                observation=request_observation(vectors[i]),
                known_free=near[i] is not None,
            )

        faults = {i: reason for i, reason in self._missing_entries().items() if i in deciding}
        try:
            answers = self._answers([i for i in deciding if i not in faults], request)
        except BadRequest:
            faults |= self._measurement_faults([i for i in deciding if i not in faults], request, states)
            answers = self._answers([i for i in deciding if i not in faults], request)
        for i in faults:
            self.backup_plans[i].fallback()
        return answers, faults

    def _answers(self, which: list[int], request: Callable[[int], Request]) -> dict[int, Answer]:
        plans = [self.backup_plans[i] for i in which]
        answers = self.client.decide_all(plans, [request(i) for i in which]) if which else []
        return dict(zip(which, answers, strict=True))

    def _measurement_faults(
        self, which: list[int], request: Callable[[int], Request], states: Sequence[Any]
    ) -> dict[int, str]:
        """Return why the states of some environments cannot be used. Raises BadRequest for any other reason."""
        faults = {}
        for i in which:
            try:
                self.client.method.decide(request(i))
            except BadRequest as error:
                if not is_measurement_fault(error, self.client.robot, states[i]):
                    raise
                faults[i] = str(error)
        return faults

    def _views(self) -> tuple[Any, Any]:
        """Return the environments' states (k, n) and lists of obstacles; None for one that has a scan only."""
        assert self._now is not None
        states = self._state(self.env, *self._now)
        if hasattr(states, "__len__") and len(states) != self.num_envs:
            raise Mismatch(
                f"state has {len(states)} rows: give one for each of the {self.num_envs} environments. If a function "
                "reads one environment, wrap each environment in a `SafetyWrapper` instead"
            )
        near = self._obstacles(self.env, *self._now) if self.client.robot.position_dim else [None] * self.num_envs
        if isinstance(near, dict):
            raise Mismatch("the obstacles are arrays, not a list for each environment: use BatchSafetyWrapper")
        near = [] if near is None else near
        if not len(near) and all(scan is not None for scan in self._scans):  # the scans alone show free space
            near = [None] * self.num_envs
        if len(near) != self.num_envs:
            raise Mismatch(f"obstacles has {len(near)} lists for {self.num_envs} environments: give a list for each")
        return states, obstacle_lists(near)

    def _missing_entries(self) -> dict[int, str]:
        """Return the environments whose own info has no state or no obstacles, where Gymnasium puts zeros or None."""
        assert self._now is not None
        missing: dict[int, str] = {}
        for name, view, default in (("obstacles", self._obstacles, OBSTACLES), ("state", self._state, STATE)):
            given = self._now[1].get(f"_{name}")
            if view is not default or given is None or (name == "obstacles" and not self.client.robot.position_dim):
                continue
            for i in np.flatnonzero(~given).tolist():
                if name == "state" or self._scans[i] is None:
                    missing[i] = f"{name} is missing in the info of this environment"
        return missing

    def _begin(self, which: NDArray[np.bool_]) -> None:
        """Begin an episode in the chosen environments (k,)."""
        for i in np.flatnonzero(which):
            self.backup_plans[i].reset()
            self._memories[i].reset()
            self._ended[i] = False

    def _remember(self, infos: dict[str, Any], which: NDArray[np.bool_]) -> None:
        """Fill in the scans of the chosen environments (k,) from memory, if the environments have any."""
        period = self.client.robot.period
        for i in np.flatnonzero(which):
            info = {"scan": infos["scan"][i]} if "scan" in infos else {}
            self._scans[i] = filled(self._memories[i], info, period)


def with_earlier_rows(infos: dict[str, Any], before: dict[str, Any], which: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the infos after a masked reset, with the earlier rows of the environments (k,) that were not reset.

    Gymnasium leaves these rows out: the values are zeros, and `_name` is False. An environment that fills in all rows
    itself has no `_name`.
    """
    joined = dict(infos)
    for name, values in before.items():
        given, now = before.get(f"_{name}"), infos.get(name)
        if given is None or name.startswith("final_"):
            continue
        if isinstance(values, dict):
            joined[name] = with_earlier_rows(now or {}, values, which)
        elif now is None:
            joined[name] = values
        elif f"_{name}" in infos and now.shape == values.shape:
            earlier = (which & given & ~infos[f"_{name}"]).reshape(-1, *[1] * (values.ndim - 1))
            joined[name] = np.where(earlier, values, now)
        else:
            continue
        joined[f"_{name}"] = infos.get(f"_{name}", False) | (which & given)
    return joined
