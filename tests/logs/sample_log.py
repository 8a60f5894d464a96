"""Write a log with every kind of event, and compute its figures independently: another reader and other formulas."""

from __future__ import annotations

import io
import math
import random
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory
from rich.console import Console, RenderableType

from brakeline.logs.segment import Attachments, Entry, Metadata, open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import robot_named

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
ABOUT = {
    "run": {"method": "ddpc", "certificate": "residual", "policy": "learning", "arena": "default", "seed": "7"},
    "configuration": {"json": '{"steps": 12}'},
    "versions": {"numpy": "1"},
    "model ground": {"version": "abc", "bound_step": "0.003"},
}


class Writer:
    """Numbers and dates messages as publishers do; loses some and duplicates others."""

    def __init__(self, seed: int = 0, losses: float = 0.01) -> None:
        self.chance = random.Random(seed)
        self.losses = losses
        self.now = BEGIN
        self.entries: list[Entry] = []
        self.published: Counter[tuple[str, int]] = Counter()

    def put(self, key: str, message: Any, run: int = 1, always: bool = False) -> None:
        self.now += self.chance.randrange(2_000_000)
        self.published[key, run] += 1
        number = self.published[key, run]
        message.header.MergeFrom(pb.Header(sequence=number, source=key.split("/")[-1], run=run, wall_time=self.now))
        if not always and self.chance.random() < self.losses:
            return
        entry = Entry(key, type(message), message.SerializeToString(), self.now + 1000, self.now, number)
        self.entries += [entry] * (1 + (not always and self.chance.random() < self.losses))

    def episode(self, actor: str, number: int, version: int = 0, robot: str = "ground", run: int = 1) -> None:
        """Write an episode of random length, decisions and outcome, or an unfinished one."""
        chance, dim = self.chance, 3 if robot == "quadrotor" else 2
        place = f"{robot}/{actor}"
        box = pb.Obstacle(kind="box", position=[1.0] * dim, size=[0.5] * dim, yaw=0.3)
        wall = pb.Obstacle(kind="wall", position=[2.5] + [0.0] * (dim - 1), yaw=math.pi)
        about = pb.Episode(robot=robot, actor=actor, episode=number, arena="default", obstacles=[box, wall])
        if dim == 3:  # a floor and a ceiling
            about.obstacles.extend(pb.Obstacle(kind="box", position=[0, 0, z], size=[6, 6, 1]) for z in (-0.5, 4.5))
        about.goal[:], about.goal_radius = [2.0] * dim, 0.25
        about.start[:] = [0.0] * robot_named(robot).state_dim
        self.put(f"episode/{place}", about, run)
        length, end = chance.randrange(3, 40), chance.choice(["goal", "collision", "timeout", "goal", "open"])
        for k in range(length):
            step = self._step(actor, number, k, robot, version)
            last = k == length - 1
            step.goal = last and end == "goal"
            step.collision = end == "collision" and k >= length - 2
            step.terminated, step.truncated = last and end in ("goal", "collision"), last and end == "timeout"
            self.put(f"exchange/{place}", self._exchange(step, dim), run)
            self.put(f"step/{place}", step, run)

    def _step(self, actor: str, number: int, k: int, robot: str, version: int) -> pb.Step:
        chance = self.chance
        dim = 3 if robot == "quadrotor" else 2
        fallback = chance.random() < 0.02
        step = pb.Step(robot=robot, actor=actor, episode=number, step=k, fallback=fallback, weights_version=version)
        step.decision = pb.FAILSAFE if fallback else chance.choice([pb.ALLOWED] * 8 + [pb.ADJUSTED] * 3 + [pb.FAILSAFE])
        if step.decision == pb.ADJUSTED:
            step.for_clearance = number % 2 == 0
        step.reward, step.penalty = chance.gauss(0.0, 1.0), chance.random()
        step.speed, step.clearance = chance.random(), chance.expovariate(3.0) + 0.01
        if number % 2:  # the others are as in a log from before
            step.closest = 0.999 * step.clearance
        step.decide_ms, step.propose_ms = (0.0 if fallback else chance.lognormvariate(-1.0, 0.5)), 0.1
        step.outside, step.compared = chance.random() < 0.01, chance.random() < 0.9
        step.contained = step.compared and chance.random() < 0.99
        step.state[:] = [0.05 * k] * dim + [0.1] * (robot_named(robot).state_dim - dim)
        step.proposed[:], step.action[:] = [0.2] * dim, [0.1] * dim
        return step

    def _exchange(self, step: pb.Step, dim: int) -> pb.Exchange:
        chance = self.chance
        request = pb.Request(robot=step.robot, actor=step.actor, episode=step.episode, step=step.step)
        request.state[:], request.action[:] = step.state, step.proposed
        if step.fallback:
            return pb.Exchange(
                request=request, failure=chance.choice(["Late: no answer within 100 ms", "NoReply: gone"])
            )
        decision = pb.Decision(
            kind=step.decision, time_ms=step.decide_ms, queue_ms=chance.expovariate(5.0), verified=True
        )
        decision.verify_ms = 0.6 * decision.time_ms
        if step.decision != pb.ALLOWED:
            decision.solver = "solved" if step.decision == pb.ADJUSTED else "primal_infeasible"
            decision.solve_ms, decision.iterations = 0.4 * decision.time_ms, chance.randrange(1, 60)
            decision.verified = chance.random() < 0.95
            decision.reason = "too near"
            normal, at = [1.0] + [0.0] * (dim - 1), [0.05 * step.step + 0.2] * dim
            decision.stopped.CopyFrom(pb.Stopped(by="box", room=-0.03, after=0.2, normal=normal, at=at))
        periods = robot_named(step.robot).horizon
        decision.plan[:] = [0.1] * dim * periods
        decision.tube_center[:] = [0.05 * step.step + 0.01 * i for i in range(periods) for _ in range(dim)]
        decision.tube_half_width[:] = [chance.uniform(0.01, 0.03) for _ in range(periods * dim)]
        decision.margin = chance.gauss(0.01, 0.01)
        exchange = pb.Exchange(
            request=request, round_trip_ms=decision.time_ms + decision.queue_ms + chance.expovariate(1.0)
        )
        exchange.reply.decision.CopyFrom(decision)
        return exchange

    def health(self, process: str, run: int = 1, last: bool = False) -> None:
        published = {key: count for (key, at), count in self.published.items() if at == run and key.endswith(process)}
        message = pb.Health(process=process, published=published, figures={"rate": 2.0}, last=last)
        self.put(f"health/{process}", message, run, always=True)

    def write(self, path: Path, portion: int = 100) -> Path:
        segment = open_segment(path, ABOUT)
        for start in range(0, len(self.entries), portion):
            segment.save(self.entries[start : start + portion])
        segment.finish()
        self.entries = []
        return segment.path


def written(
    path: Path,
    messages: Iterable[tuple[str, Any, int]],
    metadata: Metadata | None = None,
    attachments: Attachments | None = None,
) -> Path:
    """Write messages, each with its key and time of receipt [ns], to one file and return its path."""
    segment = open_segment(path, metadata or {}, attachments)
    for number, (key, message, at) in enumerate(messages):
        segment.save([Entry(key, type(message), message.SerializeToString(), at, at, number)])
    segment.finish()
    return segment.path


def mixed(folder: Path, seed: int = 0, episodes: int = 30, later: float = 0.0) -> Path:
    """Write the log of a run with three actors, two robot kinds, a restart and two segments, started `later` [s]."""
    writer = Writer(seed)
    writer.now += round(later * SECOND)
    for number in range(episodes):
        if number == episodes // 2:
            line = pb.LogLine(process="actor-1", level="WARNING", text="killed soon")
            writer.put("log/actor-1", line, 1000 * seed + 10, always=True)
            writer.write(folder / "run.mcap")
            writer.now += 100 * SECOND  # it was resumed later
        run = 1000 * seed + (20 if number >= episodes // 2 else 10)  # drawn anew at each start of a process
        for actor in ("actor-0", "actor-1"):
            writer.episode(actor, number, version=number // 3, run=run)
            writer.health(actor, run=run)
        writer.episode("drone-0", number, robot="quadrotor", run=run)
        learner = pb.LearnerMetrics(robot="ground", steps=number, updates=3 * number, weights_version=number // 3 + 1)
        writer.put("metrics/ground", learner, run, always=True)
    writer.health("actor-0", run=run, last=True)
    writer.put("log/learner", pb.LogLine(process="learner", level="INFO", text="done"), run, always=True)
    writer.write(folder / "run.mcap")
    return folder


def printed(renderable: RenderableType, width: int | None = 160, **console: Any) -> str:
    """Return what a console shows."""
    file = io.StringIO()
    Console(file=file, width=width, **console).print(renderable)
    return file.getvalue()


def decoded(paths: Iterable[Path]) -> list[tuple[str, Any]]:
    """Return the keys and messages of intact files, read by the `mcap` package."""
    found = []
    for path in paths:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
            for schema, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
                if schema is not None and schema.name.startswith("brakeline."):  # not the pictures for Foxglove
                    found.append((channel.topic, message))
    return found


def once(messages: list[tuple[str, Any]]) -> list[tuple[str, Any]]:
    """Remove duplicates: keep the first message of each sequence number of a publisher."""
    seen: set[tuple[str, int, int]] = set()
    first = []
    for key, message in messages:
        place = key, message.header.run, message.header.sequence
        if place not in seen:
            seen.add(place)
            first.append((key, message))
    return first


def percentiles(values: list[float]) -> dict[str, float] | None:
    """Compute the exact summary of all values."""
    if not values:
        return None
    p50, p90, p99 = np.percentile(values, (50, 90, 99), method="inverted_cdf")
    figures = {"count": len(values), "mean": np.mean(values), "std": np.std(values), "min": min(values)}
    return {name: float(value) for name, value in figures.items()} | {
        "p50": float(p50), "p90": float(p90), "p99": float(p99), "max": max(values)
    }  # fmt: skip


def least_clearance(step: pb.Step) -> float:
    """Return the least clearance [m] in a step's period; in a log from before, that at the period's end."""
    return float(step.closest if step.HasField("closest") else step.clearance)


def counted(messages: list[tuple[str, Any]]) -> dict[str, Any]:
    """Compute the expected figures of `analyse` from all messages."""
    every, messages = messages, once(messages)
    steps = [m for key, m in messages if key.startswith("step/")]
    exchanges = [m for key, m in messages if key.startswith("exchange/")]
    episodes: dict[tuple[str, int, int], list[Any]] = defaultdict(list)
    for step in steps:
        episodes[step.actor, step.header.run, step.episode].append(step)
    ended = [part for part in episodes.values() if part[-1].terminated or part[-1].truncated]
    whole = [part for part in ended if [s.step for s in part] == list(range(len(part)))]
    failsafe = [s for s in steps if s.fallback or s.decision == 3]
    answered = [e for e in exchanges if not e.failure]
    kinds = {"allowed": 1, "adjusted": 2, "failsafe": 3, "recovering": 4}
    inside = {
        name: [s.decide_ms for s in steps if s.decision == kind and not s.fallback] for name, kind in kinds.items()
    }
    times = [value for values in inside.values() for value in values]
    solved = [e.reply.decision for e in answered if e.reply.decision.solver]
    tubes = [e.reply.decision for e in answered if len(e.reply.decision.tube_half_width)]
    return {
        "steps": len(steps),
        "episodes": len(ended),
        "goals": sum(part[-1].goal for part in ended),
        "timeouts": sum(part[-1].truncated for part in ended),
        "collisions": sum(any(s.collision for s in part) for part in episodes.values()),
        "interventions": len(failsafe) + sum(s.decision in (2, 4) and not s.fallback for s in steps),
        "recovering": sum(s.decision == 4 and not s.fallback for s in steps),
        "contacts_moving": sum(s.contact_moving for s in steps),
        "contacts_standing": sum(s.contact_standing for s in steps),
        "contacts_robots": sum(s.contact_robot for s in steps),
        "fleet": max(s.fleet for s in steps),
        "adjusted": sum(s.decision == 2 and not s.fallback for s in steps),
        "for_clearance": sum(s.decision == 2 and s.for_clearance and not s.fallback for s in steps),
        "failsafes": len(failsafe),
        "fallbacks": sum(s.fallback for s in steps),
        "mean_speed": float(np.mean([s.speed for s in steps])),
        "max_speed": max(s.speed for s in steps),
        "mean_reward": float(np.mean([sum(s.reward for s in part) for part in whole])),
        "outside": sum(s.outside for s in steps),
        "containment": {
            "steps": sum(s.compared for s in steps), "violations": sum(s.compared and not s.contained for s in steps)
        },
        "closest_approach": min(least_clearance(s) for s in steps),
        "clearance": percentiles([s.clearance for s in steps]),
        "decision_ms": _short(times) | {name: _short(values) for name, values in inside.items()},
        "round_trip_ms": _short([e.round_trip_ms for e in answered]),
        "no_decision": dict(Counter(e.failure.split(":")[0] for e in exchanges if e.failure)),
        "latency_ms": {name: _latency(answered, kind) for name, kind in kinds.items()},
        "solver": {
            "programs": len(solved),
            "failures": sum(d.solver != "solved" for d in solved),
            "statuses": dict(Counter(d.solver for d in solved)),
            "iterations": percentiles([float(d.iterations) for d in solved]),
        },
        "unverified": sum(not e.reply.decision.verified for e in answered),
        "not_finite": sum(not np.isfinite(e.request.action).all() for e in answered),
        "tube_half_width": percentiles([max(d.tube_half_width) for d in tubes]),
        "margin": percentiles([d.margin for d in tubes]),
        "topics": _topics(every, messages),
        "log_lines": dict(Counter(m.level for key, m in messages if key.startswith("log/"))),
    }  # fmt: skip


def _short(values: list[float]) -> dict[str, float] | None:
    found = percentiles(values)
    return found and {name: found[name] for name in ("mean", "std", "p50", "p99")}


def _latency(answered: list[Any], kind: int) -> dict[str, Any]:
    own = [(e.round_trip_ms, e.reply.decision) for e in answered if e.reply.decision.kind == kind]
    return {
        "round_trip": percentiles([trip for trip, _ in own]),
        "network": percentiles([max(0.0, trip - d.queue_ms - d.time_ms) for trip, d in own]),
        "queue": percentiles([d.queue_ms for _, d in own]),
        "decide": percentiles([d.time_ms for _, d in own]),
        "solve": percentiles([d.solve_ms for _, d in own if d.solver]),
        "verify": percentiles([d.verify_ms for _, d in own]),
    }


def _topics(every: list[tuple[str, Any]], first: list[tuple[str, Any]]) -> dict[str, dict[str, int]]:
    """Count published messages: the largest sequence number of each publisher, or the count in its Health messages."""
    published: dict[tuple[str, int], int] = defaultdict(int)
    for key, message in first:
        place = key, message.header.run
        published[place] = max(published[place], message.header.sequence)
        for named, count in message.published.items() if key.startswith("health/") else ():
            if not named.startswith(("weights/", "flow/")) and count:
                published[named, message.header.run] = max(published[named, message.header.run], count)
    came, unique = Counter(key for key, _ in every), Counter(key for key, _ in first)
    totals: Counter[str] = Counter()
    for (key, _), count in published.items():
        totals[key] += count
    return {
        key: {"messages": unique[key], "missing": totals[key] - unique[key], "duplicates": came[key] - unique[key]}
        for key in totals
    }


def agree(said: Any, expected: Any, place: str = "") -> None:
    """Assert that figures have the expected values: exact counts, percentiles to 0.5 %."""
    if isinstance(expected, dict):
        assert isinstance(said, dict) and said.keys() == expected.keys(), place
        for name in expected:
            agree(said[name], expected[name], f"{place}.{name}")
    elif isinstance(expected, float) and not isinstance(said, int):
        rough = place.rsplit(".", 1)[-1] in ("p50", "p90", "p99")
        assert math.isclose(said, expected, rel_tol=0.00501 if rough else 1e-9, abs_tol=1e-9), (place, said, expected)
    else:
        assert said == expected, (place, said, expected)
