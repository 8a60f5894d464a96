"""State of the live page: the latest decision of every robot, and the counts of the run."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from typing import Any

from brakeline.errors import Implausible
from brakeline.logs.arena_view import arena_view
from brakeline.logs.decision_view import body_discs, decision_view, reservations_json
from brakeline.logs.episode_stats import INTERVENTIONS, KINDS, kind_of
from brakeline.logs.episode_view import decision_letter
from brakeline.logs.metrics import SILENT, Metrics
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.tube_stats import stated
from brakeline.logs.watch.run_history import NOTE, RunHistory, history_from_note, run_totals, totals_from_health
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.rejected_messages import headline
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import reserved_boxes

MOST_WARNINGS = 8
TRAIL = 600  # latest steps of the running episode; with many robots, fewer of each
WHOLE_TRAILS = 4  # robots that get their whole trail
STUCK = 50  # steps within one footprint of the same place after which a robot counts as stuck
FIGURES_EVERY = 1.0  # s
MOST_PANELS = 200
LAUNCHER = "launcher"  # the process that knows the run from its beginning
SETUP = ("run", "method", "arena", "seed", "steps")  # the launcher's notes about the run


NO_DECISION: dict[str, Any] = {
    "tube": [], "margin": None, "at_least": False, "said": "", "trust": "", "limited": "", "inputs": [], "arrows": [],
    "edge": [], "slow": 0.0,
}  # fmt: skip


class RobotPanel:
    """One robot in its running episode. Positions are in m, in the arena's frame.

    Attributes:
        fleet: the actors of the robot's world.
        reservation: the boxes that this robot reserves.
        reward: sum over the episode.
    """

    def __init__(self, robot: Robot, actor: str) -> None:
        self.robot, self.fleet, self.reward = robot, list[str](), 0.0
        self.reservation: list[list[float]] = []
        self._trail: deque[pb.Step] = deque(maxlen=TRAIL)  # steps of the episode
        self._steps = self._interventions = 0  # in the episode, as far as they were watched
        self._anchor: list[float] = []  # where the robot was when it last moved by more than its footprint
        self._still = 0  # steps since then
        self._shown: dict[str, Any] = NO_DECISION | {
            "actor": actor,
            "robot": robot.name,
            "footprint": robot.footprint,
            "discs": body_discs(robot),
            "period": robot.period,
            "number": 0,  # of the episode
            "arena": {},
            "pose": [],
            "kind": "",
            "around": {},
            "ended": "",  # outcome of the previous episode
        }

    def begin(self, episode: pb.Episode) -> None:
        """Show the arena of a new episode, and clear what belonged to the one before."""
        self.reward, self._steps, self._interventions, self._still = 0.0, 0, 0, 0
        self._trail.clear()
        self._anchor = []
        self._shown |= {"number": episode.episode, "arena": arena_view(episode, self.robot.position_dim)}
        self._move_to(list(episode.start))

    def decide(self, exchange: pb.Exchange) -> None:
        """Show a decision; an exchange without a decision clears the panel's tube and explanation."""
        self._shown |= NO_DECISION
        if not exchange.reply.HasField("decision"):
            return
        decision, view = exchange.reply.decision, decision_view(self.robot, exchange)
        about = view.explanation_json()
        if about:
            about |= {"said": "" if decision.kind == pb.ALLOWED else about["said"], "edge": about["edge"] or []}
        self._shown |= about | {
            "tube": view.boxes_json(),
            "margin": decision.margin,
            "at_least": decision.at_least,
            "around": view.perceived_json(),
            "slow": exchange.request.slow,
        }
        self.fleet = list(exchange.request.fleet)
        self.reservation = reservations_json(reserved_boxes(self.robot, exchange))

    def step(self, step: pb.Step) -> None:
        """Move the robot to its next state."""
        self._move_to(list(step.state))
        kind = kind_of(step)
        self._shown["kind"] = KINDS.get(kind, "")
        self.reward += step.reward
        self._trail.append(step)
        self._steps += 1
        self._interventions += kind in INTERVENTIONS
        if step.terminated or step.truncated:
            self._shown["ended"] = "collision" if step.collision else "goal" if step.goal else "time limit"

    def _move_to(self, state: list[float]) -> None:
        robot = self.robot
        if len(state) != robot.state_dim:
            raise ValueError(f"a state has {len(state)} numbers, not the {robot.state_dim} of {robot.name}")
        position = state[: robot.position_dim]
        self._shown["pose"] = [*position, *([] if robot.heading is None else [state[robot.heading]])]
        if self._anchor and math.dist(position, self._anchor) <= robot.footprint:
            self._still += 1
        else:
            self._anchor, self._still = position, 0

    def view(self, most: int = TRAIL) -> dict[str, Any]:
        """Return the panel for JSON, with the latest `most` steps of the episode."""
        steps, robot = list(self._trail)[-most:], self.robot
        states = [step.state for step in steps]
        path = {name: [state[k] for state in states] for k, name in enumerate("xyz"[: robot.position_dim])}
        return self._shown | {
            "reward": self.reward,
            "interventions": self._interventions,
            "stuck": self._still if self._still >= STUCK else 0,
            "first": steps[0].step if steps else 0,
            "path": path,
            "heading": None if robot.heading is None else [state[robot.heading] for state in states],
            "kinds": "".join(map(decision_letter, steps)),
            "clearance": [step.clearance for step in steps],
        }


class Dashboard:
    """Collects samples from one thread; other threads read `view`."""

    def __init__(self) -> None:
        self._robots = RecordedRobots()
        self.metrics = Metrics(robots=self._robots)
        self._panels: dict[str, RobotPanel] = {}
        self._warnings: deque[str] = deque(maxlen=MOST_WARNINGS)
        self._history = RunHistory()  # of what was watched
        self._started = self._last_message = time.monotonic()
        self._figures: dict[str, Any] = {}
        self._figures_at = -1e9
        self._lock = threading.Lock()

    def add(self, sample: Sample) -> None:
        """Add one message. A message of an unknown robot is ignored.

        Raises:
            Malformed, Implausible, ValueError: the page cannot show the message.
        """
        message = sample.message()
        with self._lock:
            self._last_message = time.monotonic()
            if not self.metrics.add(sample.key, message, sample.received):
                return
            if isinstance(message, pb.LogLine):
                if message.level in ("WARNING", "ERROR"):
                    self._warnings.append(f"{message.process}: {headline(message.text)}")
            elif isinstance(message, pb.Episode | pb.Step):
                self._robot(message)
            elif isinstance(message, pb.Exchange):
                panel = self._panels.get(message.request.actor)
                if panel is not None:
                    panel.decide(message)

    def _robot(self, message: pb.Episode | pb.Step) -> None:
        panel = self._panels.get(message.actor)
        if panel is None:
            robot = self._robots.named(message.robot)
            if robot is None:
                return
            panel = RobotPanel(robot, message.actor)
            if len(self._panels) == MOST_PANELS:
                raise Implausible(f"{message.actor} cannot be shown: the page shows at most {MOST_PANELS} robots")
            self._panels[message.actor] = panel
        if isinstance(message, pb.Episode):
            panel.begin(message)
        else:
            panel.step(message)

    def view(self) -> dict[str, Any]:
        """Return everything that the page shows, for JSON."""
        with self._lock:
            now = time.monotonic()
            if now - self._figures_at > FIGURES_EVERY:
                self._figures, self._figures_at = self._counts(), now
            most = TRAIL // max(1, len(self._panels) // WHOLE_TRAILS)
            panels = []
            for name, panel in sorted(self._panels.items()):
                others = [self._panels[actor] for actor in panel.fleet if actor != name and actor in self._panels]
                panels.append(
                    panel.view(most) | {"reservations": [box for other in others for box in other.reservation]}
                )
            return {"robots": panels, "silent": now - self._last_message} | self._figures

    def _counts(self) -> dict[str, Any]:
        figures = self.metrics.figures()
        learners = {
            name: {key: about[key] for key in ("steps", "updates", "steps_per_s", "updates_per_s")}
            for name, about in figures["learners"].items()
        }
        times = figures.get("decision_ms") or {}
        launcher = self.metrics.processes.get(LAUNCHER)
        reported = totals_from_health(launcher.figures) if launcher is not None else {}
        watched = run_totals(self.metrics)
        self._history.add(watched)
        history = history_from_note(launcher.notes.get(NOTE, "")) if launcher is not None else {}
        counted = reported or watched
        return {
            "run": self._run(),
            # s since this page started; None: the counts cover the whole run.
            "since": None if reported else time.monotonic() - self._started,
            "totals": {robot: _means(counts) for robot, counts in sorted(counted.items())},
            "plans": figures["plans"] | {"stated": stated(figures["plans"])},
            "decide": {"p50": times.get("p50"), "p99": times.get("p99")},
            "learners": learners,
            "processes": {name: self._state(name) for name in sorted(figures["processes"])},
            "history": (history or self._history.rows) if counted else {},
            "lines": list(self._warnings),
        }

    def _run(self) -> dict[str, str]:
        """Return the launcher's notes about the run, with `outcome` after the run's end."""
        launcher = self.metrics.processes.get(LAUNCHER)
        if launcher is None:
            return {}
        about = {name: launcher.notes[name] for name in SETUP if name in launcher.notes}
        return about if launcher.alive else about | {"outcome": launcher.notes.get("outcome", "ended")}

    def _state(self, name: str) -> str:
        """Return alive, ended (its last Health message said so) or silent (no Health message for too long)."""
        processes = self.metrics.processes
        if not processes[name].alive:
            return "ended"
        # The clocks of the processes may differ from the clock here.
        latest = max(process.last_health_at for process in processes.values())
        quiet = (latest - processes[name].last_health_at) * 1e-9 + time.monotonic() - self._last_message
        return "silent" if quiet > SILENT else "alive"


def _means(counts: dict[str, float]) -> dict[str, float | None]:
    """Replace the sum of the rewards by their mean."""
    mean = counts["reward"] / counts["episodes"] if counts["episodes"] else None
    return {name: value for name, value in counts.items() if name != "reward"} | {"mean_reward": mean}
