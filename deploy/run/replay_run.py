"""Ask the filter for each decision of a log again, and compare its decisions with the logged ones.

The same version of this software makes decisions of the same kinds, and each number is equal to within `ROUNDING`. The
last bits may differ: linear algebra libraries add in another order on another processor, or for another alignment of
arrays. A decision whose kind depends on those bits (a margin of zero) counts as different.

With another model or margin the replay shows what the filter would have decided. Each request stands alone: the robot's
past stays as it was.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import Message

from brakeline.deploy.data.data_paths import data_root
from brakeline.deploy.experiments.evaluate import asking
from brakeline.errors import LogError
from brakeline.logs.episode_stats import KINDS
from brakeline.logs.mcap_container import model_attachment_name
from brakeline.logs.reader import Damage, Log, Paths, open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.filter.filter import Filter
from brakeline.safety.methods import Method, Model, decode, load, ready
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.server import ModelRegistry

TIMES = ("time_ms", "solve_ms", "verify_ms", "queue_ms")
# Fields that depend on a key that no log holds, and fields that explain a decision without changing it.
EXPLANATIONS = ("plan_tokens", "token_rejected", "stopped", "bound", "reason")
# Fields of the solver's work, which may depend on the last bits although its solution does not.
SOLVER_WORK = ("solver", "iterations")
ROUNDING = 1e-12  # largest difference of equal numbers, relative to the number or to 1, whichever is larger
EXAMPLES = 20  # differences that the figures list, the largest ones
NAMES = {pb.UNKNOWN: "error", **KINDS}

# Incomplete requests of a fleet, by the start of its process, its robots, episode and step.
Waiting = dict[tuple[int, tuple[str, ...], int, int], dict[str, tuple[pb.Request, pb.Reply]]]
Replacement = Callable[[Robot], Method]  # gives the filter for a robot instead of the one in use


@dataclass
class Archive:
    """The methods that were in use, by version: from the log, else from the run's folder, else from the data folder.

    Attributes:
        margin: clearance margin of these methods instead of their own [m].
    """

    log: Log
    margin: float | None = None
    methods: dict[str, Method] = field(default_factory=dict)

    def add(self, file: bytes) -> None:
        """Add a model that was published during the recording. Raises BadModel, LogError."""
        method = self._ready(decode(file))
        self.methods.setdefault(method.version, method)

    def method(self, robot: str, version: str) -> Method:
        """Return the method that was in use.

        Raises:
            LogError: its model is nowhere, or has no clearance margin to replace.
            BadModel: its file is damaged or has another layout.
        """
        if version not in self.methods:
            self.methods[version] = self._ready(self._model(robot, version))
        return self.methods[version]

    def _ready(self, model: Model) -> Method:
        if self.margin is None:
            return ready(model)
        if not isinstance(model, ModelSet):
            raise LogError(f"method {model.method} has no clearance margin: leave out --margin")
        return Filter(model, self.margin)

    def _model(self, robot: str, version: str) -> Model:
        attached = self.log.attachments.get(model_attachment_name(robot, version))
        if attached is not None:
            return decode(attached)
        for root in (*dict.fromkeys(path.parent for path in self.log.paths), data_root()):
            path = root / robot / "models" / f"{version}.safetensors"
            if version.isalnum() and path.exists():
                return load(path)
        raise LogError(f"model {version} of {robot} is not in the log: copy its file to ROBOT/models/ beside it")


@dataclass(frozen=True)
class Difference:
    """The difference between two values of a field.

    Attributes:
        size: largest difference of their numbers; inf if they are no numbers or differ in length.
        rounding: whether all their numbers are equal to within ROUNDING.
    """

    size: float
    rounding: bool


@dataclass
class Comparison:
    """Counts of logged and replayed decisions.

    A decision is `identical` in every bit, or `equal` (same kind, numbers equal to within rounding), or different.
    """

    requests: int = 0
    unanswered: int = 0  # requests without a logged reply
    identical: int = 0
    equal: int = 0
    rounding: float = 0.0  # the largest difference of a number in an equal decision
    kinds: Counter[tuple[str, str]] = field(default_factory=Counter)  # (logged, now)
    fields: dict[str, list[float]] = field(default_factory=dict)  # sizes of the differences; inf: no numbers
    examples: list[tuple[tuple[float, float], dict[str, Any]]] = field(default_factory=list)  # by size, largest first
    damage: Damage = field(default_factory=Damage)  # of the log

    @property
    def different(self) -> int:
        """Number of decisions that differ by more than rounding."""
        return self.requests - self.unanswered - self.identical - self.equal

    def add(self, request: pb.Request, logged: pb.Reply, now: pb.Reply, ignored: tuple[str, ...] = ()) -> None:
        """Compare two replies to a request, without their times and the ignored fields."""
        self.requests += 1
        self.kinds[NAMES[logged.decision.kind], NAMES[now.decision.kind]] += 1
        differing = differences(logged, now, len(request.input_in_force), (*TIMES, *EXPLANATIONS, *ignored))
        if not differing:
            self.identical += 1
        elif all(difference.rounding or name in SOLVER_WORK for name, difference in differing.items()):
            self.equal += 1
            self.rounding = max(
                self.rounding, *(d.size for name, d in differing.items() if name not in SOLVER_WORK), 0.0
            )
        else:
            self._differ(request, logged, now, {name: d.size for name, d in differing.items() if not d.rounding})

    def _differ(self, request: pb.Request, logged: pb.Reply, now: pb.Reply, sizes: dict[str, float]) -> None:
        for name, size in sizes.items():
            self.fields.setdefault(name, []).append(size)
        example = {"actor": request.actor, "episode": request.episode, "step": request.step}
        example |= {"logged": NAMES[logged.decision.kind], "now": NAMES[now.decision.kind], "differences": sizes}
        # Rank by the difference of the input first, then of any field; the sort leaves the earlier of equal ones first.
        rank = sizes.get("input", 0.0), max(sizes.values())
        self.examples = sorted([*self.examples, (rank, example)], key=lambda one: one[0], reverse=True)[:EXAMPLES]

    def figures(self) -> dict[str, Any]:
        """Return the figures of the comparison, as `brakeline replay --json` prints them.

        `identical`, `equal`, `different`: numbers of decisions. `rounding`: largest difference of a number in an equal
        decision. `kinds`: for each logged kind, the numbers of kinds now. `fields`: for each field, how many decisions
        differ by more than rounding, and the largest difference (inf: no numbers). `same_input`: requests after which
        the robot gets the same input, to within rounding. `examples`: the largest differences. `cuts`, `malformed`:
        what could not be read of the log.
        """
        kinds: dict[str, dict[str, int]] = {}
        for (logged, now), count in sorted(self.kinds.items()):
            kinds.setdefault(logged, {})[now] = count
        fields = {name: {"count": len(sizes), "largest": max(sizes)} for name, sizes in sorted(self.fields.items())}
        counts = {name: getattr(self, name) for name in ("requests", "unanswered", "identical", "equal", "different")}
        otherwise = [*self.fields.get("input", ()), *self.fields.get("result", ())]  # a reply has one of them at most
        counts["same_input"] = counts["requests"] - counts["unanswered"] - len(otherwise)
        examples = [example for _, example in self.examples]
        details = {"rounding": self.rounding, "kinds": kinds, "fields": fields, "examples": examples}
        return counts | details | asdict(self.damage)


def differences(
    logged: pb.Reply, now: pb.Reply, inputs: int, ignored: tuple[str, ...] = (*TIMES, *EXPLANATIONS)
) -> dict[str, Difference]:
    """Return the fields of two replies that differ in any bit, with their differences.

    Besides the fields of the message, `input` is the first row of the plan (`inputs` numbers), which the robot gets.
    """
    if logged.WhichOneof("result") != now.WhichOneof("result"):
        return {"result": APART}
    if not now.HasField("decision"):
        return {} if logged.error.type == now.error.type else {"error": APART}
    before, after = logged.decision, now.decision
    present = {descriptor.name for descriptor, _ in before.ListFields()}
    differing: dict[str, Difference] = {}
    for descriptor in pb.Decision.DESCRIPTOR.fields:
        name = descriptor.name
        one, other = getattr(before, name), getattr(after, name)
        if descriptor.has_presence and not descriptor.message_type and name not in present:
            continue  # the log is older than the field
        if name not in ignored and one != other:
            differing[name] = APART if descriptor.enum_type is not None else _difference(one, other)
    if before.plan[:inputs] != after.plan[:inputs]:
        differing["input"] = _difference(before.plan[:inputs], after.plan[:inputs])
    return differing


APART = Difference(math.inf, False)


def _difference(one: Any, other: Any) -> Difference:
    if isinstance(one, str | bool):
        return APART
    if isinstance(one, pb.Reservation):
        one, other = ([*p.center, *p.half_width, *p.radius] for p in (one, other))
    elif isinstance(one, Message):
        return APART
    first, second = np.atleast_1d(np.array(one, float)), np.atleast_1d(np.array(other, float))
    if first.shape != second.shape:
        return APART
    with np.errstate(invalid="ignore"):  # inf - inf is NaN, which does not count as rounding
        gap = np.abs(first - second)
    return Difference(float(gap.max(initial=0.0)), bool((gap <= ROUNDING * np.maximum(np.abs(first), 1.0)).all()))


def replay(
    paths: Paths,
    instead: Replacement | None = None,
    advance: Callable[[], Any] = lambda: None,
    margin: float | None = None,
) -> Comparison:
    """Ask for each decision of a log again.

    Args:
        paths: files or run folders of the log.
        instead: gives the filter to ask instead of the one in use. It accepts the committed plans of the log.
        advance: is called after each request.
        margin: clearance margin of the model sets that were in use, instead of their own [m].

    Raises:
        LogError: the paths are no log, or a method that was in use has no clearance margin.
        LogError, BadModel: a model that was in use is missing or damaged.
    """
    log = open_log(paths)
    archive, models, result = Archive(log, margin), ModelRegistry(), Comparison()
    ask, waiting = asking(models), Waiting()
    for record in log:
        if record.topic == "model":
            archive.add(record.message.file)
        if record.topic != "exchange":
            continue
        request, logged = record.message.request, record.message.reply
        if logged.decision.token_rejected:  # the service of that time did not accept the plan
            request.model = UNVERIFIED
        if _from_before_known_free(request, logged):
            request.known_free = True
        advance()
        joint = _joint_requests(waiting, record.message)
        if any(reply.WhichOneof("result") is None for _, reply in joint):
            result.requests += len(joint)
            result.unanswered += len(joint)
            continue
        for request, logged in joint:
            if instead is not None:
                robot = log.robots.named(request.robot)
                if robot is None:
                    raise LogError(f"{request.robot!r} is neither in the log nor a robot of the program")
                _put_to_use(models, request, instead(robot))
                if request.model not in ("", UNVERIFIED):
                    request.model = models.filters[request.robot].version
            elif logged.decision.model:  # without a model the reply is an error, and the registry stays
                _put_to_use(models, request, archive.method(request.robot, logged.decision.model))
        replies = ask([request for request, _ in joint]) if joint else []
        for (request, logged), reply in zip(joint, replies, strict=True):
            result.add(request, logged, reply, () if instead is None else ("model",))
    result.damage = log.damage
    if alone := sum(map(len, waiting.values())):
        result.damage.cuts.append(
            f"{alone} requests of a fleet are not compared: those of its other robots are missing"
        )
    return result


def _from_before_known_free(request: pb.Request, logged: pb.Reply) -> bool:
    """Tell whether a request is from the time when an empty list of obstacles meant that all space is free.

    Such a request says nothing about the space around the robot, and the service did not refuse it for that.
    """
    described = request.known_free or request.obstacles or request.HasField("scan") or request.HasField("image")
    return not described and logged.error.field != "obstacles"


def _joint_requests(waiting: Waiting, exchange: pb.Exchange) -> list[tuple[pb.Request, pb.Reply]]:
    """Return the requests that were sent together: one, or those of all robots of a fleet once the last one is read."""
    request, logged = exchange.request, exchange.reply
    if not request.fleet:
        return [(request, logged)]
    key = exchange.header.run, tuple(request.fleet), request.episode, request.step
    group = waiting.setdefault(key, {})
    group[request.actor] = request, logged
    if group.keys() != set(request.fleet):
        return []
    del waiting[key]
    return [group[name] for name in request.fleet]


def _put_to_use(models: ModelRegistry, request: pb.Request, method: Method) -> None:
    """Make the registry as it was: the plan of the request may be from a version in use before the log began."""
    models.filters[request.robot] = method
    models.known |= {method.version, request.model}
