"""Every exception of Brakeline, in one tree. `except BrakelineError` catches what the package raises on purpose.

An exception's message says what happened, where, and what to do next. Exceptions that stand for a wrong argument are
also `ValueError`s, so code that catches those keeps working.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from brakeline.messaging import brakeline_pb2 as pb


class BrakelineError(Exception):
    """The base of every exception that Brakeline raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Say how to copy the exception, also to another process: `Pool` waits for ever for one that it cannot copy.

        Python calls the class with `args`, which holds the message alone.
        """
        return _copied, (type(self), self.args), vars(self)


def _copied(kind: type[BrakelineError], args: tuple[Any, ...]) -> BrakelineError:
    """Return an exception without its attributes."""
    return kind.__new__(kind, *args)


class MissingExtra(BrakelineError, ImportError):
    """An optional package is not installed. The message names the extra that brings it."""


# --- Robots, tasks, obstacles and the bus ---


class BusError(BrakelineError):
    """Base class of the errors of the bus."""


class Unreachable(BusError):
    """No router answers at any endpoint, or the process cannot listen on an endpoint."""


class BadKeys(BusError):
    """A key or certificate is missing or too short, or a bus that other machines can reach has no keys."""


class NoReply(BusError):
    """No service answers this query, or the service has ended."""


class Late(BusError):
    """The deadline passed without a reply."""


class Busy(BusError):
    """The queue of queries is full."""


class Expired(BusError):
    """The deadline of a query passed while it was in the queue."""


class Malformed(BusError, ValueError):
    """The bytes cannot be decoded as a message of the topic's type, or the message is implausible."""


class Refused(BusError):
    """The service replied with an error.

    Attributes:
        type: name of the error.
        field: the invalid field of the query, or empty.
        text: the message.
    """

    def __init__(self, error: pb.Error) -> None:
        super().__init__(f"{error.type}: {error.message}")
        self.type, self.field, self.text = error.type, error.field, error.message


class InvalidField(BrakelineError, ValueError):
    """A value is invalid. `field` names it."""

    def __init__(self, field: str | InvalidField, message: str = "") -> None:
        again = field if isinstance(field, InvalidField) else None  # Gymnasium raises a worker's `type(error)(error)`
        super().__init__(message if again is None else str(again))
        self.field: str = str(field) if again is None else again.field


class BadText(BrakelineError, ValueError):
    """A text is not JSON or TOML, or is nested too deeply."""


class BadLink(BrakelineError, ValueError):
    """A link's URL has a form that `brakeline.messaging.byte_links` does not support."""


class Implausible(BrakelineError, ValueError):
    """A message has a time, a name or a size that no correct sender uses, or there are too many senders."""


class BadShape(InvalidField):
    """An obstacle is invalid."""


class BadWeights(BrakelineError, ValueError):
    """The layers of a network are invalid, or the policy is of another robot; the message names the part."""


class UnknownRobot(BrakelineError, ValueError):
    """No robot has this name, or its description is invalid."""

    field = "robot"  # the field of a request that is wrong


class BadDescription(UnknownRobot):
    """A robot description has mistakes.

    Attributes:
        problems: (field, mistake and allowed values) of every mistake.
    """

    def __init__(self, source: str, problems: Sequence[tuple[str, str]]) -> None:
        lines = "".join(f"\n  {field}: {text}" if field else f"\n  {text}" for field, text in problems)
        super().__init__(f"{source} is no robot's description:{lines}")
        self.problems = problems


class BadRosName(BrakelineError, ValueError):
    """A name or token is not valid in ROS."""


class BadScan(BrakelineError, ValueError):
    """A scan or range image is invalid."""

    field = "scan"


class UnknownTask(BrakelineError, ValueError):
    """The robot has no such task, or the task's file has mistakes, which the message lists."""


# --- Data, models and decisions ---


class Mismatch(BrakelineError, ValueError):
    """The robot does not fit its environment or the program. The message says what to give."""


class BadRequest(InvalidField):
    """The filter cannot decide on the request."""


class StaleModel(BadRequest):
    """The backup plan was verified by a model set that the service does not know."""


class BadData(BrakelineError, ValueError):
    """The data set must not be used; the message says which check failed."""


class ErrorBoundError(BrakelineError, ValueError):
    """The data do not support the error bound; the message says why."""


class BadModel(BrakelineError, ValueError):
    """The model set must not be used; the message says why."""


class TooLoose(BadModel):
    """The model set states a larger share of plans outside their tubes than you accept; the message says what to do."""


class BadTensors(BrakelineError, ValueError):
    """The bytes are not a safetensors file of the expected kind."""


class SafetyError(BusError):
    """The service answered a request with an error, or its reply is not valid. `field` names the wrong field."""

    def __init__(self, error: pb.Error) -> None:
        super().__init__(f"{error.type or 'Error'}: {error.message or 'the service gives no reason'}")
        self.type, self.field = error.type, error.field


class AskedApart(BadRequest):
    """A request does not name every robot of a shared world exactly once, so the service cannot check reservations."""

    def __init__(self, message: str) -> None:
        super().__init__("fleet", message)


class NoModel(BadRequest):
    """The service has no model of the robot."""


class Untrusted(BadModel):
    """No trusted signer signed the model, or the model is not what was signed."""


# --- Simulation ---


class UnknownName(BrakelineError, ValueError):
    """The robot has no arena, policy or rule set of this name; the message lists the names."""


class NoCluster(BrakelineError, RuntimeError):
    """There is no Ray cluster at an address."""


class NoArena(BrakelineError, RuntimeError):
    """No drawn arena has a path from start to goal: the settings of the arena leave too little room."""


class RequestRefused(BrakelineError):
    """The vehicle refuses a command or a setpoint now; the message says why."""


class UnknownMode(RequestRefused):
    """The requested mode does not exist."""


class AutopilotGone(BrakelineError, RuntimeError):
    """The autopilot no longer answers, or does not support lockstep."""


class BadParameter(BrakelineError, ValueError):
    """The parameter does not exist, or cannot have this value."""


class NoFleet(BrakelineError, ValueError):
    """Several robots cannot share a world: their kind, the arena or the conditions do not allow it."""


class NoBatch(BrakelineError, ValueError):
    """Many robots cannot be simulated at once: their kind, the arena or the conditions do not allow it."""


class BadInput(BrakelineError, ValueError):
    """The input is not a finite vector with one number for each of the robot's inputs."""


# --- Actors and their vehicles ---


class TakeoffNotVerified(BrakelineError, ValueError):
    """The filter cannot verify that the vehicle may hover where the flight begins."""


class RefusedByLearner(BrakelineError, RuntimeError):
    """The learner does not accept this actor: their layouts differ, or the learner has enough actors."""


class MavlinkError(BrakelineError, RuntimeError):
    """The autopilot does not carry out a command."""


class CommandLost(MavlinkError):
    """The vehicle disarmed or restarted, or its estimate jumped: the actor must not fly it any more."""


class NoAutopilot(MavlinkError):
    """No heartbeat of PX4 or ArduPilot arrives."""


class CommandRefused(MavlinkError):
    """The COMMAND_ACK has another result than accepted, or there is none."""


class TelemetryMissing(MavlinkError):
    """The autopilot sends none of the messages that carry a quantity which the flight needs."""


class HandoverRefused(MavlinkError):
    """The server does not hand the vehicle over to this actor, which has to take control of it anew."""


class BadMessage(BrakelineError, ValueError):
    """A message is not valid: its receiver drops it, and goes on."""


class InputMissing(BrakelineError):
    """An input of a decision is missing or stale; the message says which."""


class PoseJumped(InputMissing):
    """A robot's odometry made a step that the robot can't: no plan from before counts as verified any more."""


# --- Learning ---


class CheckpointError(BrakelineError, RuntimeError):
    """There is no checkpoint, it is of another run, or it could not be written; the message says which."""


class DamagedPart(CheckpointError):
    """A part of the checkpoint is missing, damaged, or does not fit; `part` names it."""

    def __init__(self, part: str, where: Path, why: str) -> None:
        super().__init__(
            f"{where}: the part {part!r} is {why}. Restore the folder from a copy; or move it away, and learn again "
            "from the log: `brakeline train --resume RUN --from-logs RUN`"
        )
        self.part = part


class Diverged(BrakelineError, RuntimeError):
    """The learner's weights or losses are no longer finite. The message says what to do."""


class BadStep(InvalidField):
    """The learner cannot learn from the step."""

    def __init__(self, field: str, why: str) -> None:
        super().__init__(field, f"{field}: {why}")


# --- Logs ---


class LogError(BrakelineError):
    """The log is missing, damaged, being recorded, or lacks what is needed; the message says which."""


class NotMcap(BrakelineError):
    """The file does not start with the MCAP magic bytes."""


class ExportError(BrakelineError, ValueError):
    """The log cannot be exported."""


# --- Commands and runs ---


class Unsupported(BadData):
    """No kind of windows supports a model set. `reasons` maps each kind to the reason; the message lists them."""

    def __init__(self, reasons: dict[str, str]) -> None:
        super().__init__("; ".join(f"{kind} windows: {reason}" for kind, reason in reasons.items()))
        self.reasons = reasons


class FlightEnded(BrakelineError, RuntimeError):
    """The flight ended early; the message gives the reason. The data up to then remain valid."""


class NoSource(BadData):
    """A source cannot be read as data of a robot; the message gives the reason and the remedy."""


class ResultError(BrakelineError, ValueError):
    """An existing result was made with other settings, or the log of a run disagrees with the run's figures."""


class WorkerKilled(BrakelineError, RuntimeError):
    """Something killed a worker process of a study."""


class LaunchError(BrakelineError, RuntimeError):
    """A run, or its PX4, can't start or go on. The message says what to do."""
