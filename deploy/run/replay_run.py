"""`brakeline replay`: ask the filter every question of a log again, and compare its answers with the logged ones.

The same version of this software decides the same kinds, and every number of a decision is equal to within `ROUNDING`.
The last bits may differ: linear algebra libraries add in another order on another processor, or where arrays lie
otherwise in memory. A decision whose kind hung on those last bits (a margin of zero) counts as different.

With another model or margin the replay says what the filter would have decided: each request stands for itself, with
the past as it was.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import Message

from brakeline.deploy.data.data_paths import data_root
from brakeline.logs.episode_stats import KINDS
from brakeline.logs.mcap_container import model_attachment_name
from brakeline.logs.reader import Log, Paths, open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.methods import Method, decode, load, ready
from brakeline.safety.service.server import ModelRegistry, ServiceCounts, batch_handler

TIMES = ("time_ms", "solve_ms", "verify_ms", "queue_ms")
# What a service says to itself, with a key that no log holds; and what explains a decision, and changes none.
WORDS = ("plan_tokens", "token_rejected", "stopped", "bound")
# How the solver came by an answer: its way may hang on the last bits where its answer does not.
WORK = ("solver", "iterations")
ROUNDING = 1e-12  # of a number (of 1, if the number is smaller) by which two decisions may differ and still be equal
EXAMPLES = 20  # decisions that are told in full: those with the largest differences
NAMES = {pb.UNKNOWN: "error", **KINDS}

Waiting = dict[tuple[tuple[str, ...], int, int], dict[str, tuple[pb.Request, pb.Reply]]]  # fleets not yet whole
Replacement = Callable[[Robot], Method]  # what is asked about a robot in place of what was in use


class ReplayError(ValueError):
    """The log cannot be replayed; the message says what is missing."""


@dataclass
class Archive:
    """The methods that were in use, by their model's version: from the log, else the run's folder, else the data."""

    log: Log
    methods: dict[str, Method] = field(default_factory=dict)

    def add(self, file: bytes) -> None:
        """A model that was published while the log was recorded. Raises BadModel."""
        method = ready(decode(file))
        self.methods.setdefault(method.version, method)

    def method(self, robot: str, version: str) -> Method:
        """
        Raises:
            ReplayError: it is nowhere; BadModel: its file is damaged or of another layout.
        """
        if version not in self.methods:
            self.methods[version] = ready(self._model(robot, version))
        return self.methods[version]

    def _model(self, robot: str, version: str) -> Any:
        attached = self.log.attachments.get(model_attachment_name(robot, version))
        if attached is not None:
            return decode(attached)
        for root in (*dict.fromkeys(path.parent for path in self.log.paths), data_root()):
            path = root / robot / "models" / f"{version}.safetensors"
            if version.isalnum() and path.exists():
                return load(path)
        raise ReplayError(f"model {version} of {robot} is neither in the log nor in its folder: what was in use?")


@dataclass(frozen=True)
class Difference:
    """Between two values of a field: the largest difference of their numbers (inf if they have none), and whether all
    of it is rounding."""

    size: float
    rounding: bool


@dataclass
class Comparison:
    """What a log's decisions and the replayed ones have in common.

    An answer is `identical` in every bit; or `equal`: of the same kind, with numbers that differ by rounding alone; or
    different.
    """

    requests: int = 0
    unanswered: int = 0  # no reply came in time: nothing to compare with
    identical: int = 0
    equal: int = 0
    rounding: float = 0.0  # the largest difference of a number in an equal decision
    kinds: Counter[tuple[str, str]] = field(default_factory=Counter)  # (logged, now)
    fields: dict[str, list[float]] = field(default_factory=dict)  # sizes of differences; inf: not to be measured
    _worst: list[tuple[tuple[float, float, int], dict[str, Any]]] = field(default_factory=list)  # a heap

    @property
    def different(self) -> int:
        return self.requests - self.unanswered - self.identical - self.equal

    def add(self, request: pb.Request, logged: pb.Reply, now: pb.Reply, ignored: tuple[str, ...] = ()) -> None:
        """Compare two replies to a request, but for their times and what else is to be ignored."""
        self.requests += 1
        self.kinds[NAMES[logged.decision.kind], NAMES[now.decision.kind]] += 1
        found = differences(logged, now, len(request.input_in_force), (*TIMES, *WORDS, *ignored))
        if not found:
            self.identical += 1
        elif all(difference.rounding or name in WORK for name, difference in found.items()):
            self.equal += 1
            self.rounding = max(self.rounding, *(d.size for name, d in found.items() if name not in WORK), 0.0)
        else:
            self._differ(request, logged, now, {name: d.size for name, d in found.items() if not d.rounding})

    def _differ(self, request: pb.Request, logged: pb.Reply, now: pb.Reply, sizes: dict[str, float]) -> None:
        for name, size in sizes.items():
            self.fields.setdefault(name, []).append(size)
        where = {"actor": request.actor, "episode": request.episode, "step": request.step}
        kinds = {"logged": NAMES[logged.decision.kind], "now": NAMES[now.decision.kind]}
        # First by what the robot does; of equals the earliest.
        rank = sizes.get("input", 0.0), max(sizes.values()), -self.requests
        push = heapq.heappushpop if len(self._worst) == EXAMPLES else heapq.heappush
        push(self._worst, (rank, where | kinds | {"differences": sizes}))

    def figures(self) -> dict[str, Any]:
        """`identical`, `equal`, `different`: numbers of answers; `rounding`: the largest difference of a number in an
        equal one; `kinds`: what was decided, and of that what is decided now; `fields`: of the different ones, per
        field how many differ by more than rounding, and by how much at most (inf: where it is no number, or of another
        size); `same_input`: requests after which the robot does the same, but for rounding; `examples`: the largest
        differences."""
        kinds: dict[str, dict[str, int]] = {}
        for (logged, now), count in sorted(self.kinds.items()):
            kinds.setdefault(logged, {})[now] = count
        fields = {name: {"count": len(sizes), "largest": max(sizes)} for name, sizes in sorted(self.fields.items())}
        counts = {name: getattr(self, name) for name in ("requests", "unanswered", "identical", "equal", "different")}
        otherwise = sum(len(self.fields.get(name, ())) for name in ("input", "result"))  # never both
        counts["same_input"] = counts["requests"] - counts["unanswered"] - otherwise
        worst = [example for _, example in sorted(self._worst, key=lambda item: item[0], reverse=True)]
        return counts | {"rounding": self.rounding, "kinds": kinds, "fields": fields, "examples": worst}


def differences(
    logged: pb.Reply, now: pb.Reply, inputs: int, ignored: tuple[str, ...] = (*TIMES, *WORDS)
) -> dict[str, Difference]:
    """The fields of two replies that differ in any bit, and by how much.

    `input` is the plan's first row, `inputs` numbers: what the robot is told to do now.
    """
    if logged.WhichOneof("result") != now.WhichOneof("result"):
        return {"result": APART}
    if not now.HasField("decision"):
        return {} if logged.error.type == now.error.type else {"error": APART}
    before, after = logged.decision, now.decision
    said = {descriptor.name for descriptor, _ in before.ListFields()}
    found: dict[str, Difference] = {}
    for descriptor in pb.Decision.DESCRIPTOR.fields:
        name = descriptor.name
        one, other = getattr(before, name), getattr(after, name)
        if descriptor.has_presence and not descriptor.message_type and name not in said:
            continue  # a log from before there was such a field
        if name not in ignored and one != other:
            found[name] = APART if descriptor.enum_type is not None else _difference(one, other)
    if before.plan[:inputs] != after.plan[:inputs]:
        found["input"] = _difference(before.plan[:inputs], after.plan[:inputs])
    return found


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
    with np.errstate(invalid="ignore"):  # infinite ones: NaN, which is no rounding
        off = np.abs(first - second)
    return Difference(float(off.max(initial=0.0)), bool((off <= ROUNDING * np.maximum(np.abs(first), 1.0)).all()))


def replay(paths: Paths, instead: Replacement | None = None, each: Callable[[], Any] = lambda: None) -> Comparison:
    """Ask every question of the log at `paths` again; `each` is called after every one.

    With `instead`, the plans that were committed to count as verified by what is asked now.

    Raises:
        NoLog, NotALog: there is none; ReplayError, BadModel: a model that was in use cannot be had.
    """
    log = open_log(paths)
    archive, models, result = Archive(log), ModelRegistry(), Comparison()
    answer = batch_handler(models, ServiceCounts())
    waiting: Waiting = {}
    for record in log:
        if record.topic == "model":
            archive.add(record.message.file)
        if record.topic != "exchange":
            continue
        request, logged = record.message.request, record.message.reply
        if logged.decision.token_rejected:  # by the log's own word; else what the request says is believed
            request.model = UNVERIFIED
        if _from_before_known_free(request, logged):
            request.known_free = True
        each()
        questions = _question(waiting, request, logged)
        if any(reply.WhichOneof("result") is None for _, reply in questions):
            result.requests += len(questions)
            result.unanswered += len(questions)
            continue
        for request, logged in questions:
            if instead is not None:
                robot = log.robots.named(request.robot)
                if robot is None:
                    raise ReplayError(
                        f"the log does not describe {request.robot!r}, and no such robot comes with the program"
                    )
                _put_to_use(models, request, instead(robot))
                if request.model not in ("", UNVERIFIED):
                    request.model = models.filters[request.robot].version
            elif logged.decision.model:  # else it is an error, of whatever was in use
                _put_to_use(models, request, archive.method(request.robot, logged.decision.model))
        replies = _asked(answer, [request for request, _ in questions]) if questions else []
        for (request, logged), reply in zip(questions, replies, strict=True):
            result.add(request, logged, reply, () if instead is None else ("model",))
    return result


def _from_before_known_free(request: pb.Request, logged: pb.Reply) -> bool:
    """Does a request say nothing about the space around the robot, and was it not refused for that? Then it is from
    before requests had to, when an empty list of obstacles meant that all space is free."""
    said = request.known_free or request.obstacles or request.HasField("scan") or request.HasField("image")
    return not said and logged.error.field != "obstacles"


def _question(waiting: Waiting, request: pb.Request, logged: pb.Reply) -> list[tuple[pb.Request, pb.Reply]]:
    """What was one question with this request: itself; of a fleet all its robots', once the last of them is there."""
    if not request.fleet:
        return [(request, logged)]
    key = tuple(request.fleet), request.episode, request.step
    group = waiting.setdefault(key, {})
    group[request.actor] = request, logged
    if group.keys() != set(request.fleet):
        return []
    del waiting[key]
    return [group[name] for name in request.fleet]


def _put_to_use(models: ModelRegistry, request: pb.Request, method: Method) -> None:
    """As the service was when it decided: the version before may have been used before this log began."""
    models.filters[request.robot] = method
    models.known |= {method.version, request.model}


def _asked(answer: Callable[[bytes], bytes], requests: Sequence[pb.Request]) -> list[pb.Reply]:
    """The service's own core is asked: the same bytes, no bus."""
    return list(pb.ReplyBatch.FromString(answer(pb.RequestBatch(requests=requests).SerializeToString())).replies)
