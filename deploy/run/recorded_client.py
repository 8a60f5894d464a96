"""Record what a program of your own asks the filter: a client that also writes the log of a run.

with RecordedClient(InProcess(Filter.load("ground")), "runs/mine") as safety:
    answer = safety.decide(state, action, obstacles)      # once a period, as without a log
    safety.record_outcome(reward)                         # if your program has rewards
    safety.reset(goal=True)                               # the end of an episode

brakeline analyse runs/mine --html report.html
"""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from brakeline.errors import BadRequest, BusError
from brakeline.extras import missing_extra
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.body_clearance import body_clearance
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.inbox import Inbox
from brakeline.messaging.message_checks import MAX_VALUE, NAME
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.messaging.steady_clock import steady_time_ns
from brakeline.messaging.topics import EXCHANGE, STEP, Topic
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.service.client import request_message
from brakeline.safety.service.filter_client import Answer, FilterClient, obstacles_in
from brakeline.safety.service.wire import decision_reply, set_decision

if TYPE_CHECKING:
    from brakeline.logs.recorder import Recording

LOG = "run.mcap"
PERIOD = 0.5  # s between two writes


class RecordedClient:
    """A client of the filter that writes each request, each answer and each step of the robot to a log.

    It has the methods of the client that it wraps, so a `SafetyWrapper` takes it, too, and calls `record_outcome`. A
    thread writes the log twice a second, as `brakeline recorder` does; while the disk is full, it keeps up to 64 MiB in
    memory and tries again.

    The log states what your program knows: positions and speeds are the measured ones, clearances are those to the
    obstacles of the requests (none with a scan alone). Rewards, goals and collisions are those of `record_outcome` and
    `reset`. Without these calls, `analyse` says that they are not recorded. A step is complete when the next request
    has the state after it, so the last decision of an episode has no step, and its outcome counts for the step before.
    The only decision of an episode has a step with the state before it.

    >>> from brakeline import Filter, InProcess
    >>> with RecordedClient(InProcess(Filter.load("ground")), FOLDER / "mine") as safety:
    ...     safety.decide(state=[0, 0, 0, 0, 0], action=[0.2, 0], known_free=True).kind
    'allowed'
    """

    def __init__(self, client: FilterClient, folder: Path | str, name: str = "program") -> None:
        """Begin a log.

        Args:
            client: an `InProcess` or a `SafetyClient`.
            folder: of the new log, `run.mcap`.
            name: of the robot in the log, with letters, digits, dots, dashes and underscores.

        Raises:
            FileExistsError: the folder has a log. Nothing is ever written over it.
            OSError: the log cannot be written.
            TypeError: `client` is no client of one robot.
            ValueError: `name` has other characters.
            MissingExtra: the extra `logs` is not installed.
        """
        if not isinstance(client, FilterClient):
            raise TypeError(f"one robot's client is needed here, not a {type(client).__name__}: give InProcess(filter)")
        if not NAME.fullmatch(name):
            raise ValueError(f"the name {name!r:.200}: use up to 100 letters, digits, dots, dashes and underscores")
        self.client, self.path = client, Path(folder) / LOG
        if self.path.exists():
            raise FileExistsError(f"{self.path} exists: give the log a folder of its own")
        self._name, self._run = name, secrets.randbits(32)
        self._inbox, self._sequences = Inbox(), dict.fromkeys((EXCHANGE, STEP), 0)
        self._recording = _recording(self.path, client, self._inbox)
        self._recording.save()
        if self._recording.failure:
            raise OSError(self._recording.failure)
        self._began, self._episode, self._step, self._index = steady_time_ns(), 0, 0, 0
        self._pending: pb.Step | None = None  # of the current period: the state after it is not known yet
        self._complete: pb.Step | None = None  # the one before: it waits, since the episode may end with it
        self._asked_at = 0.0  # time of the latest request [s]
        self._before: Array | None = None  # the state before the current period, if a request had it
        self._latest: Array | None = None  # the state of the episode's latest request
        self._unmeasured = pb.Step()  # the outcomes of periods whose end no request had: they count for the next one
        self._near = Shapes.of([], client.robot.position_dim)
        self._closed = threading.Event()
        self._writer = threading.Thread(target=self._write, name=f"log {self.path}", daemon=True)
        self._writer.start()

    @property
    def robot(self) -> Robot:
        return self.client.robot

    @property
    def backup_plan(self) -> BackupPlan:
        return self.client.backup_plan

    def decide(
        self,
        state: ArrayLike,
        action: ArrayLike,
        obstacles: Iterable[Obstacle] | None = None,
        *,
        scan: RangeMeasurement | None = None,
        observation: ArrayLike | None = None,
        known_free: bool = False,
    ) -> Answer:
        """Decide as the client does, and record the request and its answer.

        Raises what the client raises; BusError: the log is closed. Then `fallback` brakes the robot.
        """
        if self._closed.is_set():
            raise BusError(f"{self.path} is closed, so nothing is recorded: make another RecordedClient")
        listed = None if obstacles is None else obstacles_in(obstacles)
        more: dict[str, Any] = {"scan": scan, "observation": observation, "known_free": known_free}
        now = (steady_time_ns() - self._began) * 1e-9
        about: dict[str, Any] = {"actor": self._name, "episode": self._episode, "step": self._step, "time": now}
        request = request_message(self.backup_plan, state, action, listed, **more, **about)
        self._finish_step(request)
        exchange = pb.Exchange(request=request)
        exchange.header.time = now
        try:
            answer = self.client.decide(state, action, listed, **more)
        except (BusError, BadRequest) as error:
            exchange.failure = f"{type(error).__name__}: {error}"
            self._put(EXCHANGE, exchange)
            raise
        exchange.round_trip_ms = (steady_time_ns() - self._began) * 1e-6 - now * 1e3
        exchange.reply.CopyFrom(decision_reply(answer, answer.queue_ms))
        exchange.reply.robot = self.robot.name
        exchange.reply.decision.token_rejected = answer.token_rejected
        self._put(EXCHANGE, exchange)
        self._near = Shapes.of([o for o in listed or () if o.motion is None], self.robot.position_dim)
        self._begin_step(request.action, answer.action, answer)
        return answer

    def fallback(self) -> Array:
        """Return the backup plan's next input, for a period without a decision, and record it."""
        action = self.client.fallback()
        self._begin_step(action.tolist(), action)
        return action

    def record_outcome(self, reward: float, *, goal: bool = False, collision: bool = False) -> None:
        """Record a period's reward, after its `decide` or `fallback`; after the last one also how the episode ended.

        A reward that is not finite, or 1e9 and more, counts as zero, because a log with it has no sums.
        """
        reward = reward if abs(reward) < MAX_VALUE else 0.0
        if self._pending is not None:
            step = self._pending
            step.reward, step.goal, step.collision, step.outcome_stated = reward, goal, collision, True
        elif self._latest is not None:  # `decide` failed, and the program stops the robot without `fallback`
            stated = pb.Step(reward=reward, goal=goal, collision=collision, outcome_stated=True)
            _add_outcome(self._unmeasured, stated)

    def reset(self, *, goal: bool | None = None, collision: bool | None = None) -> None:
        """End the episode and begin the next one with a robot that stands still.

        The arguments say how the episode ended. Without them, `analyse` counts outcomes only if `record_outcome` stated
        them.
        """
        if (goal, collision) != (None, None):
            self._unmeasured.outcome_stated = True
        self._end_episode(bool(goal), bool(collision))
        self.client.reset()

    def close(self) -> None:
        """End the episode, and write the rest of the log. Raises OSError: the disk is full, so the rest is lost."""
        if self._closed.is_set():
            return
        self._end_episode()
        self._closed.set()
        self._writer.join()
        self._recording.finish()
        if self._inbox.dropped:
            lost = self._inbox.dropped.total()
            raise OSError(f"{self.path}: {lost} messages are lost: {self._recording.failure or 'too many to write'}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _begin_step(self, proposed: Iterable[float], action: Array, answer: Answer | None = None) -> None:
        """Note what the robot executes in this period; without an answer, it is the backup plan's input."""
        if self._pending is not None:  # the period before had no request, so nobody measured its end
            self._before = None
            _add_outcome(self._unmeasured, self._pending)
        finite = bool(np.isfinite(proposed := np.fromiter(proposed, float)).all())
        step = pb.Step(
            robot=self.robot.name,
            actor=self._name,
            episode=self._episode,
            step=self._step,
            proposed=(proposed if finite else action).tolist(),
            action=action.tolist(),
            decision=pb.FAILSAFE,
            fallback=answer is None,
            acceleration_age=self.backup_plan.acceleration_age,
        )
        if answer is not None:
            set_decision(step, answer)
        self._pending = step
        self._step += 1

    def _finish_step(self, request: pb.Request) -> None:
        """Complete the step of the last period with the state of a request, which is the state after it."""
        step, self._pending, self._asked_at = self._pending, None, request.time
        self._latest = np.array(request.state)
        if step is None:
            self._before = np.array(request.state)
            return
        self._put_complete()
        state, predicted = np.array(request.state), self.backup_plan.predicted
        d = self.robot.position_dim
        if self._before is not None:
            step.speed = float(np.linalg.norm(state[:d] - self._before[:d])) / self.robot.period
        if predicted is not None:
            step.compared, step.contained = True, predicted.contains(self.robot, state)
        self._complete_step(step, state, request.time)
        self._before = state

    def _complete_step(self, step: pb.Step, state: Array, time: float) -> None:
        """Note the state at the end of a period. The step waits for the next one: the episode may end with it."""
        self._index += 1
        step.index = self._index
        self._take_unmeasured(step)
        step.state.extend(state.tolist())
        step.header.time = time
        step.clearance = step.closest = float(body_clearance(self.robot, self._near, state))
        self._complete = step

    def _end_episode(self, goal: bool = False, collision: bool = False) -> None:
        """Mark the last complete step as the episode's end. The period after it has no measured end, so no step."""
        last = self._pending
        if self._complete is None and last is not None and self._latest is not None:
            self._complete_step(last, self._latest, self._asked_at)  # the only period: else its outcome would be lost
        if (end := self._complete) is not None:
            if last is not None and last is not end:
                _add_outcome(self._unmeasured, last)
            goal = goal or self._unmeasured.goal or (last is end and end.goal)
            self._take_unmeasured(end)
            end.goal, end.collision = goal, collision or end.collision
            end.terminated = end.goal or end.collision
            end.truncated = not end.terminated
        self._put_complete()
        self._episode += bool(self._step)
        self._pending, self._before, self._latest, self._step = None, None, None, 0
        self._unmeasured.Clear()

    def _take_unmeasured(self, step: pb.Step) -> None:
        """Let a step have the outcomes of the periods before it without a measured end."""
        _add_outcome(step, self._unmeasured)
        self._unmeasured.Clear()

    def _put_complete(self) -> None:
        if self._complete is not None:
            self._put(STEP, self._complete)
            self._complete = None

    def _put(self, topic: Topic, message: pb.Step | pb.Exchange) -> None:
        """Number a message, and pass it to the thread that writes."""
        self._sequences[topic] += 1
        header, now = message.header, steady_time_ns()
        header.sequence, header.source, header.run = self._sequences[topic], self._name, self._run
        header.wall_time = now
        key = topic.at(robot=self.robot.name, source=self._name)
        self._inbox.put(Sample(topic, key, message.SerializeToString(), now))

    def _write(self) -> None:
        while not self._closed.wait(PERIOD):
            self._recording.save()


def _add_outcome(step: pb.Step, other: pb.Step) -> None:
    """Add the outcome of another period to that of a step."""
    step.reward += other.reward
    step.goal, step.collision = step.goal or other.goal, step.collision or other.collision
    step.outcome_stated = step.outcome_stated or other.outcome_stated


def _recording(path: Path, client: FilterClient, inbox: Inbox) -> Recording:
    """Return what writes the log. With a filter in this process, it holds the model set, so a replay needs no more."""
    try:
        from brakeline.logs.episode_stats import OWN_PROGRAM
        from brakeline.logs.mcap_container import model_attachment_name
        from brakeline.logs.recorder import LogSettings, Recording
    except ModuleNotFoundError as error:
        raise missing_extra(error) or error from error
    robot, model = client.robot, getattr(getattr(client, "method", None), "model", None)
    run = {"policy": OWN_PROGRAM, "robots": robot.name}
    metadata = {"run": run, "versions": {"brakeline": version("brakeline")}}
    metadata["robots"] = {robot.kind: json.dumps(robot.description)}
    files = {}
    if model is not None:
        metadata[f"model {robot.name}"] = {"version": model.version, **model.about}
        files[model_attachment_name(robot.name, model.version)] = model.encode()
    return Recording(LogSettings(path, metadata, files), inbox)
