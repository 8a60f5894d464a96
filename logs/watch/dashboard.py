"""What the live page shows: the latest of every robot, and the figures of the run."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from brakeline.logs.decision_explanation import explain, fits
from brakeline.logs.episode_view import discs
from brakeline.logs.foxglove_scene import half_width
from brakeline.logs.metrics import SILENT, Crowded, Metrics
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.tube_stats import stated
from brakeline.logs.watch.run_totals import run_totals, totals_from_health
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.obstacle import WALL
from brakeline.messaging.rejected_messages import headline
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import map_for_display, reserved_boxes

LINES = 8  # of warnings
EPISODES = 300  # whose rewards are drawn
TRAIL = 600  # positions of the running episode
FIGURES_EVERY = 1.0  # s
MOST_CARDS = 200
KINDS = {pb.ALLOWED: "allowed", pb.ADJUSTED: "adjusted", pb.FAILSAFE: "failsafe", pb.RECOVERING: "recovering"}
LAUNCHER = "launcher"  # the process that knows the run from its beginning
SETUP = ("run", "method", "arena", "seed", "steps")  # its notes about it


@dataclass
class RobotPanel:
    """One robot, in its running episode. Positions are x and y in m, in the arena's frame."""

    robot: Robot
    actor: str
    number: int = 0  # of the episode
    arena: dict[str, Any] = field(default_factory=dict)
    pose: list[float] = field(default_factory=list)  # x, y, heading (0 where there is none)
    height: float | None = None  # m, in space
    kind: str = ""
    tube: list[list[float]] = field(default_factory=list)  # per period: center x, y, half-width x, y
    margin: float | None = None
    at_least: bool = False  # the margin is a lower bound
    said: str = ""  # why it was not as proposed
    trust: str = ""  # what the plan's having been verified is worth, where `said` does not say it
    inputs: list[tuple[str, str, float, float]] = field(default_factory=list)  # name, unit, proposed, executed
    arrows: list[list[float]] = field(default_factory=list)  # of the proposed and the executed input, m
    edge: list[float] = field(default_factory=list)  # of what stopped the proposal: a point, and the normal there
    around: dict[str, list[Any]] = field(default_factory=dict)  # `DisplayedMap.flat`
    fleet: list[str] = field(default_factory=list)  # the actors of its world
    reservation: list[list[float]] = field(default_factory=list)  # boxes: center x, y, half-width x, y with the radius
    trail: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=TRAIL))
    marks: deque[tuple[float, float, str]] = field(default_factory=lambda: deque(maxlen=TRAIL))  # interventions
    reward: float = 0.0
    ended: str = ""  # how the episode before this one ended

    def begin(self, episode: pb.Episode) -> None:
        self.number, self.reward = episode.episode, 0.0
        self.trail.clear()
        self.marks.clear()
        half = half_width(episode)
        # Floors and ceilings would cover all; walls are the square's edges.
        inside = [o for o in episode.obstacles if o.kind != WALL and max(o.size) < 2.0 * half]
        self.arena = {
            "half": half,
            "obstacles": [
                {"kind": o.kind, "at": list(o.position[:2]), "size": list(o.size), "yaw": o.yaw} for o in inside
            ],
            "goal": list(episode.goal[:2]),
            "goal_radius": episode.goal_radius,
        }
        self._stand(list(episode.start))

    def decide(self, exchange: pb.Exchange) -> None:
        if not exchange.reply.HasField("decision"):
            self.tube, self.margin = [], None
            self._unexplained()
            return
        decision, d = exchange.reply.decision, self.robot.position_dim
        centers, halves = decision.tube_center, decision.tube_half_width
        if len(centers) != len(halves) or len(centers) % d or len(centers) > self.robot.horizon * d:
            raise ValueError(f"a tube of {len(centers)} and {len(halves)} numbers")
        self.tube = [[*centers[i : i + 2], *halves[i : i + 2]] for i in range(0, len(centers), d)]
        self.margin, self.at_least = decision.margin, decision.at_least
        self.around = map_for_display(self.robot, exchange.request).flat()
        self.fleet = list(exchange.request.fleet)
        boxes = reserved_boxes(self.robot, exchange)
        self.reservation = [[*box[:2].tolist(), *(box[d : d + 2] + box[-1]).tolist()] for box in boxes]
        self._explain(exchange.request, decision)

    def _explain(self, request: pb.Request, decision: pb.Decision) -> None:
        if not fits(self.robot, request, decision):
            self._unexplained()
            return
        about = explain(self.robot, request, decision)
        self.said = "" if decision.kind == pb.ALLOWED else about.said
        self.trust = about.trust
        self.inputs, self.arrows = about.inputs, [about.proposed[:2].tolist(), about.executed[:2].tolist()]
        self.edge = [*about.at[:2].tolist(), *about.normal[:2].tolist()] if len(about.at) else []

    def _unexplained(self) -> None:
        self.said, self.trust, self.inputs, self.arrows, self.edge = "", "", [], [], []

    def step(self, step: pb.Step) -> None:
        self._stand(list(step.state))
        self.kind = "failsafe" if step.fallback else KINDS.get(step.decision, "")
        self.reward += step.reward
        x, y, _ = self.pose
        self.trail.append((x, y))
        if self.kind in ("adjusted", "failsafe", "recovering"):
            self.marks.append((x, y, self.kind))
        if step.terminated or step.truncated:
            self.ended = "collision" if step.collision else "goal" if step.goal else "time limit"

    def _stand(self, state: list[float]) -> None:
        if len(state) != self.robot.state_dim:
            raise ValueError(f"a state of {len(state)} numbers, a {self.robot.name} robot's has {self.robot.state_dim}")
        heading = 0.0 if self.robot.heading is None else state[self.robot.heading]
        self.pose = [state[0], state[1], heading]
        self.height = state[2] if self.robot.position_dim == 3 else None

    def view(self) -> dict[str, Any]:
        names = (
            *("actor", "number", "arena", "pose", "height", "kind", "tube", "margin", "at_least", "reward", "ended"),
            *("said", "trust", "inputs", "arrows", "edge", "around"),
        )
        about = {name: getattr(self, name) for name in names}
        lists = {"trail": list(self.trail), "marks": list(self.marks)}
        return about | lists | {"robot": self.robot.name, "footprint": self.robot.footprint, "discs": discs(self.robot)}


class Dashboard:
    """Takes samples in one thread; others ask for its `view`."""

    def __init__(self) -> None:
        self._robots = RecordedRobots()
        self.metrics = Metrics(robots=self._robots)
        self._cards: dict[str, RobotPanel] = {}
        self._lines: deque[str] = deque(maxlen=LINES)
        self._returns: dict[str, deque[float]] = {}  # by robot kind
        self._begun = self._heard = time.monotonic()
        self._figures: dict[str, Any] = {}
        self._figures_at = -1e9
        self._lock = threading.Lock()

    def take(self, sample: Sample) -> None:
        """One message; one of a robot that is not known here is left out.

        Raises:
            Malformed, Crowded, ValueError: it can't be shown.
        """
        message = sample.message()
        with self._lock:
            self._heard = time.monotonic()
            self.metrics.add(sample.key, message)
            if isinstance(message, pb.LogLine):
                if message.level in ("WARNING", "ERROR"):
                    self._lines.append(f"{message.process}: {headline(message.text)}")
            elif isinstance(message, pb.Episode | pb.Step):
                self._robot(message)
            elif isinstance(message, pb.Exchange):
                card = self._cards.get(message.request.actor)
                if card is not None:
                    card.decide(message)

    def _robot(self, message: pb.Episode | pb.Step) -> None:
        card = self._cards.get(message.actor)
        if card is None:
            robot = self._robots.named(message.robot)
            if robot is None:
                return
            card = RobotPanel(robot, message.actor)
            if len(self._cards) == MOST_CARDS:
                raise Crowded(f"{message.actor} is one robot more than the {MOST_CARDS} that are shown")
            self._cards[message.actor] = card
        if isinstance(message, pb.Episode):
            card.begin(message)
            return
        card.step(message)
        if message.terminated or message.truncated:
            self._returns.setdefault(card.robot.name, deque(maxlen=EPISODES)).append(card.reward)

    def view(self) -> dict[str, Any]:
        """All that the page shows, as JSON can hold it."""
        with self._lock:
            now = time.monotonic()
            if now - self._figures_at > FIGURES_EVERY:
                self._figures, self._figures_at = self._count(), now
            cards = [self._cards[name].view() | {"promises": self._promises(name)} for name in sorted(self._cards)]
            return {"robots": cards, "silent": now - self._heard} | self._figures

    def _promises(self, name: str) -> list[list[float]]:
        """The boxes in which the other robots of its world promise to be."""
        others = (self._cards[actor] for actor in self._cards[name].fleet if actor != name and actor in self._cards)
        return [box for card in others for box in card.reservation]

    def _count(self) -> dict[str, Any]:
        figures = self.metrics.figures()
        learners = {
            name: {key: about[key] for key in ("steps", "updates", "steps_per_s", "updates_per_s")}
            for name, about in figures["learners"].items()
        }
        times = figures.get("decision_ms") or {}
        launcher = self.metrics.processes.get(LAUNCHER)
        whole = totals_from_health(launcher.figures) if launcher is not None else {}
        counted = whole or run_totals(self.metrics)
        return {
            "run": self._run(),
            # Counts of the whole run, or only of what was seen here.
            "since": None if whole else time.monotonic() - self._begun,
            "totals": {robot: _means(counts) for robot, counts in sorted(counted.items())},
            "plans": figures["plans"] | {"stated": stated(figures["plans"])},
            "decide": {"p50": times.get("p50"), "p99": times.get("p99")},
            "learners": learners,
            "processes": {name: self._state(name) for name in sorted(figures["processes"])},
            "returns": {robot: list(returns) for robot, returns in sorted(self._returns.items())},
            "lines": list(self._lines),
        }

    def _run(self) -> dict[str, str]:
        """What the launcher says of the run; `outcome` once it has ended. Without one, nothing."""
        launcher = self.metrics.processes.get(LAUNCHER)
        if launcher is None:
            return {}
        about = {name: launcher.notes[name] for name in SETUP if name in launcher.notes}
        return about if launcher.alive else about | {"outcome": launcher.notes.get("outcome", "ended")}

    def _state(self, name: str) -> str:
        """alive; ended: it said goodbye; silent: it did not, and nothing is heard of it."""
        processes = self.metrics.processes
        if not processes[name].alive:
            return "ended"
        latest = max(process.heard_at for process in processes.values())  # by their clock, which may not be ours
        quiet = (latest - processes[name].heard_at) * 1e-9 + time.monotonic() - self._heard
        return "silent" if quiet > SILENT else "alive"


def _means(counts: dict[str, float]) -> dict[str, float | None]:
    """Counts with the mean reward in place of its sum."""
    mean = counts["reward"] / counts["episodes"] if counts["episodes"] else None
    return {name: value for name, value in counts.items() if name != "reward"} | {"mean_reward": mean}
