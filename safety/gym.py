"""The filter (or a rival: `safety/methods.py`) in front of any policy, as a Gymnasium wrapper.

env = SafetyWrapper(NavigationEnv(robot), Filter(ModelSet.load(path)))
model = AnyLibrary("MlpPolicy", env).learn(...)

Of an environment that knows nothing of this:

env = SafetyWrapper.load(env, path, state=state, obstacles=obstacles, actions=normalised(robot))
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.bus import BusError
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.safety.action_mapping import ActionMapping, cast_action, mapping_for_space
from brakeline.safety.environment_views import OBSTACLES, STATE, View
from brakeline.safety.filter.backup_plan import correction_penalty
from brakeline.safety.perception.image_memory import filled, memory_of
from brakeline.safety.service.filter_client import Answer, FilterClient
from brakeline.safety.service.in_process import InProcess, request_observation

if TYPE_CHECKING:
    from brakeline.safety.methods import Method

Array = NDArray[np.float64]

UNANSWERED = "unanswered"  # in place of a decision's kind: the service was not there, and the committed plan went on


class SafetyWrapper(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Replaces each action by the filter's decision on it.

    `info` may hold `scan` (`Scan`, in space `RangeImage`) in the obstacles' place. The wrapper adds, after `step`:
    `safety` (the `Answer`, None if a service gave none), `proposed` (the action given), `penalty`, and `diagnostics`, a
    dict of plain values: kind, verified, contained, margin [m], time_ms, model, reason, bound (the largest share of
    verified plans that leave their tubes, as stated; NaN: none is), and proposed and executed as inputs of the robot.
    The penalty is subtracted from the reward.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        filter: Method | FilterClient,
        penalty: float = 0.0,
        *,
        state: View = STATE,
        obstacles: View = OBSTACLES,
        actions: ActionMapping | None = None,
        accept_bound: float | None = None,
    ) -> None:
        """
        Args:
            filter: or an asker: `SafetyClient` asks a service, and brakes along the committed plan without an answer.
            penalty: of leaning on the filter, in reward (`correction_penalty`).
            state: (env, observation, info) -> measured state (n,); unless given, `info["state"]`.
            obstacles: likewise -> a list of `Obstacle` with at least those within `filter.reach`, as a map says: where
                the list has nothing, space is free. None instead of a list: nothing is known, but by a scan.
            actions: between the environment's actions and the robot's inputs; unless given they are the same.
            accept_bound: of a filter, the largest stated share of plans outside their tubes that is accepted; unless
                given the limit of the robot's description counts.

        Raises:
            Mismatch: the action space is not that of the robot's inputs, and `actions` is not given.
            TooLoose: the model set's statement is looser than that.
        """
        super().__init__(env)
        self.asker = filter if isinstance(filter, FilterClient) else InProcess(filter, accept_bound)
        self.penalty, self.backup_plan = penalty, self.asker.backup_plan
        self._state, self._obstacles = state, obstacles
        self._actions = mapping_for_space(env.action_space, self.asker.robot, actions)
        self._now: tuple[Any, dict[str, Any]] | None = None
        self._memory = memory_of(self.asker.robot)
        self._scan: RangeMeasurement | None = None

    @classmethod
    def load(cls, env: gymnasium.Env[Any, Any], model: Path | str, penalty: float = 0.0, **how: Any) -> Self:
        """With the model in a file.

        Raises:
            BadModel: it is none; TooLoose, Mismatch: see above.
        """
        from brakeline.safety.methods import load, ready  # what only asks a service needs no solver

        return cls(env, ready(load(Path(model))), penalty, **how)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._now = self.env.reset(seed=seed, options=options)
        self.backup_plan.reset()
        self._memory.reset()
        self._remember()
        return self._now

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._now is None:
            raise gymnasium.error.ResetNeeded("reset the environment before anything else")
        before = self.backup_plan.next_input
        wanted = np.asarray(self._actions.action_to_control(action), dtype=float)
        answer, reason = self._decide(wanted)
        executed = self.backup_plan.next_input
        made = cast_action(self._actions.control_to_action(executed), self.env.action_space)
        observation, reward, terminated, truncated, info = self.env.step(made)
        cost = correction_penalty(self.asker.robot, wanted, before, executed, self.penalty)
        told = diagnostics(answer, reason) | {"proposed": wanted, "executed": executed}
        info = info | {"safety": answer, "proposed": action, "penalty": cost, "diagnostics": told}
        self._now = observation, info
        self._remember()
        return observation, float(reward) - cost, terminated, truncated, info

    def _decide(self, wanted: Array) -> tuple[Answer | None, str]:
        """The decision, committed to, or None and why there is none: then the committed plan goes on."""
        assert self._now is not None
        seen = self._now[0], self._now[1]
        state, near = self._state(self.env, *seen), self._obstacles(self.env, *seen)
        observation, known_free = request_observation(seen[0]), near is not None
        try:
            answer = self.asker.decide(
                state, wanted, near, scan=self._scan, observation=observation, known_free=known_free
            )
            return answer, ""
        except BusError as error:
            self.asker.fallback()
            return None, str(error)

    def _remember(self) -> None:
        """The scan, if there is one, with what was seen free before."""
        assert self._now is not None
        self._scan = filled(self._memory, self._now[1], self.asker.robot.period)


def diagnostics(answer: Answer | None, reason: str = "") -> dict[str, Any]:
    """The figures of a decision as a dict."""
    if answer is None:
        return {"kind": UNANSWERED, "verified": False, "contained": False, "margin": np.nan, "time_ms": np.nan} | {
            "model": "",
            "reason": reason,
            "bound": np.nan,
        }
    names = ("kind", "verified", "contained", "margin", "time_ms", "model", "reason")
    return {name: getattr(answer, name) for name in names} | {"bound": np.nan if answer.bound is None else answer.bound}
