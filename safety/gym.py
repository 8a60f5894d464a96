"""A Gymnasium wrapper that puts the filter, or a rival, in front of any policy.

env = SafetyWrapper(NavigationEnv(robot), Filter(ModelSet.load(path)))
model = AnyLibrary("MlpPolicy", env).learn(...)

For an environment that does not provide the robot's state and obstacles in `info`:

env = SafetyWrapper.load(env, path, state=state, obstacles=obstacles, actions=normalised(robot))
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from brakeline.errors import BadRequest, BusError, Mismatch, TooLoose
from brakeline.messaging.number_checks import check_numbers
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.messaging.stated_share import percent
from brakeline.safety.action_mapping import ActionMapping, action_for, mapping_for_space
from brakeline.safety.environment_views import OBSTACLES, STATE, View, copied
from brakeline.safety.filter.backup_plan import correction_penalty
from brakeline.safety.gym_checks import age_of_acceleration, check_resets, check_robot
from brakeline.safety.perception.image_memory import filled, memory_of
from brakeline.safety.service.filter_client import Answer, FilterClient
from brakeline.safety.service.in_process import InProcess, request_observation

if TYPE_CHECKING:
    from brakeline.safety.methods import Method


# In place of a decision's kind: no service answered, or the state could not be used, so the backup plan continued.
UNANSWERED = "unanswered"
# How an episode ended, in the words of `RecordedClient.record_outcome` and of `info`.
OUTCOMES = {"goal": "at_goal", "collision": "collision"}


class SafetyWrapper(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Replaces each action by the filter's decision on it, and subtracts a penalty from the reward.

    >>> from brakeline import Filter
    >>> env = SafetyWrapper(gymnasium.make("brakeline.envs:brakeline/Ground-v0"), Filter.load("ground"))
    >>> observation, info = env.reset(seed=0)
    >>> env.step(np.zeros(2))[4]["safety"].verified
    True

    `info` may hold `scan` (a `Scan`, or a `RangeImage` in space) instead of obstacles. `step` adds to `info`:

        safety: the `Answer`; None if a service did not answer, or if the measured state is missing, not finite or not
            plausible. Then the robot continues its backup plan.
        proposed: the action that the policy proposed.
        penalty: subtracted from the reward.
        diagnostics: a dict of plain values: kind, verified, contained, margin [m], model, reason, bound (the
            probability that a verified plan leaves its tube, as the validation report states it; NaN without one), and
            the proposed and the executed input.
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
        turn_aside: bool = False,
        acceleration_age: float | None = None,
    ) -> None:
        """Wrap an environment.

        Args:
            env: the environment.
            filter: a method, or a client of a service, such as `SafetyClient`.
            penalty: reward for a correction as large as an input's range (`correction_penalty`).
            state: (env, observation, info) -> measured state (n,). Defaults to `info["state"]`.
            obstacles: (env, observation, info) -> list of at least the obstacles within the robot's `sight`, and the
                moving ones that may come so near before a plan ends. All other space is free. None: only a scan shows
                free space. Defaults to `info["obstacles"]`. In joint space there are no obstacles, so it is not called.
            actions: mapping between the environment's actions and the robot's inputs. Defaults to the identity.
            accept_bound: largest accepted probability that a verified plan leaves its tube, as the model set's
                validation report states it. Defaults to the limit in the robot's description; with a client, to the
                limit of the client or of its service.
            turn_aside: turn a robot that is blocked towards the nearest direction in which it can drive on. A client
                whose backup plan asks for it does so anyway.
            acceleration_age: the states hold the horizontal acceleration of this long ago [s]. Defaults to
                `info["acceleration_age"]` of `reset`, or to that of the client, or to 0. If the data of the model set
                have another age, `reset` raises `Mismatch`.

        Raises:
            Mismatch: the action space is not that of the robot's inputs, and `actions` is not given. Or the environment
                states its robot (`env.unwrapped.robot`), and its description is not that of the filter. Or a wrapper
                inside resets the environment by itself.
            TooLoose: the validation report states a larger probability, or there is no report. With a client of a
                service, `step` raises it, since only the answers state the probability.
            ValueError: `accept_bound` is not above 0 and at most 1, or the penalty is negative or not finite.
        """
        kept = {"penalty": penalty, "state": state, "obstacles": obstacles, "actions": actions}
        kept |= {"accept_bound": accept_bound, "turn_aside": turn_aside, "acceleration_age": acceleration_age}
        if not isinstance(filter, FilterClient):  # a client has the backup plan of one robot: no second one may use it
            kept["filter"] = filter
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **kept)
        gymnasium.Wrapper.__init__(self, env)
        self.client = filter if isinstance(filter, FilterClient) else InProcess(filter, accept_bound)
        self._limit = 1.0 if accept_bound is None else _checked_limit(self.client, accept_bound)
        check_robot(env, self.client.robot)
        check_resets(env)
        self.penalty, self.backup_plan = penalty, self.client.backup_plan
        check_numbers(self, "penalty", least=0.0)
        self.backup_plan.turn_aside |= turn_aside
        self._state, self._obstacles, self._acceleration_age = state, obstacles, acceleration_age
        self._actions = mapping_for_space(env.action_space, self.client.robot, actions)
        self._now: tuple[Any, dict[str, Any]] | None = None
        self._memory = memory_of(self.client.robot)
        self._scan: RangeMeasurement | None = None
        self._plan: Any = None  # the plan that this wrapper committed to last

    @classmethod
    def load(cls, env: gymnasium.Env[Any, Any], model: Path | str, penalty: float = 0.0, **how: Any) -> Self:
        """Wrap an environment with a model; how: the keyword arguments of the constructor.

        Args:
            model: the path of a model set or of a rival's model, or the name of a shipped robot (`"ground"`,
                `"quadrotor"`).

        Raises:
            BadModel: the file holds no model, or no shipped robot has that name.
            TooLoose, Mismatch: see the constructor.
        """
        from brakeline.safety.methods import load, ready  # a client of a service needs no solver
        from brakeline.safety.model.model_set import path_of_model

        return cls(env, ready(load(path_of_model(model))), penalty, **how)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        age, method = self.backup_plan.acceleration_age, getattr(self.client, "method", None)
        self.backup_plan.acceleration_age = age_of_acceleration(info, self._acceleration_age, age, method)
        self._now = copied((observation, info))
        self.client.reset()
        self._plan = self.backup_plan.plan
        self._memory.reset()
        self._remember()
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._now is None:
            raise gymnasium.error.ResetNeeded("reset the environment before the first step")
        if self.backup_plan.plan is not self._plan:
            raise Mismatch(
                "another environment uses this client, which has the backup plan of one robot: make one for each"
            )
        before = self.backup_plan.next_input
        proposed = np.array(self._actions.action_to_control(action), dtype=float)  # `action` may be overwritten
        answer, reason = self._decide(proposed)
        executed, self._plan = self.backup_plan.next_input, self.backup_plan.plan
        safe_action = action_for(executed, self._actions, self.env.action_space)
        observation, reward, terminated, truncated, info = self.env.step(safe_action)
        if (record := getattr(self.client, "record_outcome", None)) is not None:  # of a `RecordedClient`
            ended = terminated or truncated
            record(float(reward), **{name: ended and bool(info.get(key)) for name, key in OUTCOMES.items()})
        penalty = correction_penalty(self.client.robot, proposed, before, executed, self.penalty)
        figures = diagnostics(answer, reason) | {"proposed": proposed, "executed": executed}
        info = info | {"safety": answer, "proposed": action, "penalty": penalty, "diagnostics": figures}
        self._now = copied((observation, info))
        self._remember()
        return observation, float(reward) - penalty, terminated, truncated, info

    def _decide(self, proposed: Array) -> tuple[Answer | None, str]:
        """Return the decision and commit to it; or None and the reason, and continue the backup plan."""
        assert self._now is not None
        state = self._state(self.env, *self._now)
        near = self._obstacles(self.env, *self._now) if self.client.robot.position_dim else None
        observation, known_free = request_observation(self._now[0]), near is not None
        try:
            answer = self.client.decide(
                state, proposed, near, scan=self._scan, observation=observation, known_free=known_free
            )
            if answer.bound is not None and answer.bound > self._limit:
                self._plan = self.backup_plan.plan  # ours: the next step raises the same error
                raise TooLoose(
                    f"{self.client.robot.name}: the service's model set {answer.model} states only that at most "
                    f"{percent(answer.bound)} of plans leave their tubes; accept_bound is {percent(self._limit)}"
                )
            return answer, ""
        except BadRequest as error:
            if not is_measurement_fault(error, self.client.robot, state):
                raise
            reason = str(error)
        except BusError as error:
            if getattr(error, "field", "") == "acceleration_age":  # the service would refuse every step
                raise
            reason = str(error)
        self.client.fallback()
        return None, reason

    def _remember(self) -> None:
        """Fill in the scan from memory, if the environment has one."""
        assert self._now is not None
        self._scan = filled(self._memory, self._now[1], self.client.robot.period)


def _checked_limit(client: FilterClient, accept_bound: float) -> float:
    """Return the accepted bound. Raises TooLoose: the client has a model set that states more; ValueError: no share."""
    from brakeline.safety.model.stated_bound import accepted_bound, check_bound  # a client of a service loads no model

    method = getattr(client, "method", None)
    check_bound(getattr(method, "model", None), client.robot, accept_bound)
    return accepted_bound(client.robot, accept_bound)


def is_measurement_fault(error: BadRequest, robot: Robot, state: Any) -> bool:
    """Return whether a request was refused because its state is missing, not finite or not plausible.

    Each other refusal is a mistake in the program, such as a state of the wrong size.
    """
    sized = state is None or np.asarray(state, dtype=object).shape == (robot.state_dim,)
    return error.field == "state" and sized


def diagnostics(answer: Answer | None, reason: str = "") -> dict[str, Any]:
    """Return the figures of a decision; reason: of a missing one."""
    if answer is None:
        nothing = {"margin": np.nan, "bound": np.nan, "model": ""}
        return {"kind": UNANSWERED, "verified": False, "contained": False, "reason": reason} | nothing
    names = ("kind", "verified", "contained", "margin", "model", "reason")
    return {name: getattr(answer, name) for name in names} | {"bound": np.nan if answer.bound is None else answer.bound}
