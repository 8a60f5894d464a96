"""The filter in front of a vector of environments: one call decides for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.action_mapping import ActionMapping, Mismatch, mapping_for_space
from brakeline.safety.environment_views import OBSTACLES, STATE, View
from brakeline.safety.filter.backup_plan import BackupPlan, correction_penalty
from brakeline.safety.gym import diagnostics
from brakeline.safety.perception.image_memory import filled, memory_of
from brakeline.safety.service.in_process import InProcess, request_observation

if TYPE_CHECKING:
    from brakeline.safety.methods import Method

Array = NDArray[np.float64]


class VectorSafetyWrapper(VectorWrapper):
    """`SafetyWrapper` of a `gymnasium.vector` environment, whatever its autoreset mode.

    `state(env, observations, infos)` gives (k, n), `obstacles` k lists, `actions` maps (k, m); all of them unless given
    as `SafetyWrapper` has them, and scans in `infos` likewise. `infos` gains `safety` (k answers; None where an
    environment is being reset), `penalty` (k,) and `diagnostics` (a dict of k values each).
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
    ) -> None:
        """
        Raises:
            Mismatch: the action space is not that of the robot's inputs, and `actions` is not given.
            TooLoose: the model set's statement is looser than what is used (`InProcess`).
        """
        super().__init__(env)
        self.asker, self.penalty = InProcess(filter, accept_bound), penalty
        self.backup_plans = [BackupPlan(filter.robot) for _ in range(env.num_envs)]
        self._state, self._obstacles = state, obstacles
        self._actions = mapping_for_space(env.single_action_space, filter.robot, actions)
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._ended = np.zeros(env.num_envs, dtype=bool)
        self._now: tuple[Any, dict[str, Any]] | None = None
        self._memories = [memory_of(filter.robot) for _ in range(env.num_envs)]
        self._scans: list[RangeMeasurement | None] = [None] * env.num_envs

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._now = self.env.reset(seed=seed, options=options)
        self._begin((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        self._remember(self._now[1])
        return self._now

    def step(self, actions: Any) -> tuple[Any, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        if self._now is None:
            raise gymnasium.error.ResetNeeded("reset the environment before anything else")
        robot, seen = self.asker.robot, self._now
        wanted = np.asarray(self._actions.action_to_control(actions), dtype=float)
        # In the mode NEXT_STEP an environment that has ended takes no action, it is reset.
        resets = self._ended if self._mode == AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, dtype=bool)
        deciding = np.flatnonzero(~resets)
        before = np.array([kept.next_input for kept in self.backup_plans])
        states, near = self._state(self.env, *seen), self._obstacles(self.env, *seen)
        near = [] if near is None else near
        if not len(near) and all(scan is not None for scan in self._scans):  # only these say what is free
            near = [None] * self.num_envs
        if len(near) != self.num_envs:
            raise Mismatch(f"obstacles were told for {len(near)} of {self.num_envs} environments: give a list for each")
        answers = self.asker.decide_all(
            [self.backup_plans[i] for i in deciding],
            [states[i] for i in deciding],
            [wanted[i] for i in deciding],
            [near[i] for i in deciding],
            scans=[self._scans[i] for i in deciding],
            observations=[
                request_observation(seen[0][i] if isinstance(seen[0], np.ndarray) else None) for i in deciding
            ],
            known_free=[near[i] is not None for i in deciding],
        )
        executed = np.array([kept.next_input for kept in self.backup_plans])
        executed[resets] = robot.zero_input()
        space = self.env.action_space
        made = np.asarray(self._actions.control_to_action(executed), dtype=space.dtype).reshape(space.shape)
        observations, rewards, terminated, truncated, infos = self.env.step(made)
        decided = dict(zip(deciding.tolist(), answers, strict=True))
        penalty = np.zeros(self.num_envs)
        for i in deciding:
            penalty[i] = correction_penalty(robot, wanted[i], before[i], executed[i], self.penalty)
        self._ended = np.asarray(terminated | truncated)
        self._begin(self._ended if self._mode == AutoresetMode.SAME_STEP else resets)
        self._remember(infos)
        safety = np.array([decided.get(i) for i in range(self.num_envs)], dtype=object)
        told = [diagnostics(one, "" if one is not None else "reset") for one in safety]
        infos = infos | {
            "safety": safety,
            "penalty": penalty,
            "diagnostics": {name: np.array([one[name] for one in told]) for name in told[0]},
        }
        self._now = observations, infos
        return observations, np.asarray(rewards) - penalty, terminated, truncated, infos

    def _begin(self, which: NDArray[np.bool_]) -> None:
        """These environments stand at an episode's start."""
        for i in np.flatnonzero(which):
            self.backup_plans[i].reset()
            self._memories[i].reset()
            self._ended[i] = False

    def _remember(self, infos: dict[str, Any]) -> None:
        """The scans, if there are any, with what was seen free before."""
        by_environment = [{"scan": scan} for scan in infos["scan"]] if "scan" in infos else [{}] * self.num_envs
        period = self.asker.robot.period
        self._scans = [
            filled(memory, info, period) for memory, info in zip(self._memories, by_environment, strict=True)
        ]


def view_each_environment(view: Callable[[Any, Any, dict[str, Any]], Any]) -> View:
    """A vector's view from that of one environment, for `SyncVectorEnv`: asks each with its own observation and what
    `infos` has of it."""

    def views(env: Any, observations: Any, infos: dict[str, Any]) -> list[Any]:
        own = env.unwrapped.envs
        return [
            view(one, observations[i], {k: v[i] for k, v in infos.items() if _held(v, len(own))})
            for i, one in enumerate(own)
        ]

    return views


def _held(values: Any, count: int) -> bool:
    return isinstance(values, np.ndarray) and len(values) == count
