"""`brakeline query` and `brakeline status`: look at a running system."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from rich.markup import escape

from brakeline.deploy.commands.common_options import Endpoints, Flags, Robot, console, say_json
from brakeline.logs.console_tables import PLAIN, StackingTable
from brakeline.messaging.bus import Bus, Sample
from brakeline.messaging.obstacle import KINDS, Obstacle
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import robot_named
from brakeline.messaging.scan import BadScan, Scan
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.messaging.stated_share import describe_verification
from brakeline.messaging.topics import HEALTH, LEARNER
from brakeline.safety.service.client import SafetyClient


def obstacle_of(words: tuple[str, ...], dim: int) -> Obstacle:
    """KIND, position, sizes, and a box's or wall's yaw if one number is left. Raises ValueError with the form."""
    form = "an obstacle is: cylinder X Y RADIUS | box X Y LENGTH WIDTH [YAW] | wall X Y YAW"
    kind, numbers = words[0] if words else "", words[1:]
    if kind not in KINDS:
        raise ValueError(f"{kind!r}: {form}")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        raise ValueError(f"{' '.join(words)}: {form}") from None
    sizes = {"box": dim, "cylinder": dim - 1, "sphere": 1, "wall": 0}[kind]
    if len(values) not in (dim + sizes, dim + sizes + 1):
        raise ValueError(f"{' '.join(words)}: {form}")
    yaw = values[dim + sizes] if len(values) > dim + sizes else 0.0
    return Obstacle(kind, tuple(values[:dim]), tuple(values[dim : dim + sizes]), yaw)


def sensed_in(path: Path, dim: int) -> RangeMeasurement:
    """What a file says was seen: a JSON object with the fields of a `Scan`, in the air (dim 3) of a `RangeImage`.

    Raises:
        BadScan: it says something else; OSError: there is no such file.
    """
    kind = Scan if dim == 2 else RangeImage
    names = [field.name for field in fields(kind) if field.name != "followed"]
    try:
        said = json.loads(path.read_text())
        if not isinstance(said, dict) or not said.keys() <= set(names):
            raise BadScan(f"{path}: not a {kind.__name__}, which is a JSON object of {', '.join(names)}")
        return kind(**said)
    except (TypeError, ValueError) as error:  # no JSON, a field missing, or no numbers in it
        raise error if isinstance(error, BadScan) else BadScan(f"{path}: not a {kind.__name__}: {error}") from error


@dataclass(frozen=True)
class Query:
    robot: Robot = "ground"
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    state: tuple[float, ...] = ()
    """Measured state in the robot's order; default: at rest at the origin."""
    action: tuple[float, ...] = ()
    """Proposed; default: the highest inputs."""
    obstacle: str = ""
    """What is near, separated by commas, e.g. "cylinder 0.4 0 0.1, wall 1 0 3.14"."""
    scan: Path | None = None
    """What was seen, beside it: a JSON file, {"ranges": [...], "angles": [...], "pose": [0, 0, 0], ...}, with the
    fields of a Scan, in the air of a RangeImage (docs/perception.md). What it does not show to be free is occupied."""
    known_free: bool = False
    """Say that nothing but the obstacles is near. Needed without --obstacle and --scan."""
    timeout: float = 1.0
    json: bool = False

    def run(self) -> int:
        robot = robot_named(self.robot)
        near = [
            obstacle_of(tuple(part.split()), robot.position_dim) for part in self.obstacle.split(",") if part.strip()
        ]
        state = self.state or (0.0,) * robot.state_dim
        action = self.action or robot.action_high
        scan = None if self.scan is None else sensed_in(self.scan, robot.position_dim)
        with Bus(self.endpoints.bus(), f"client.query-{time.time_ns() % 10**6}") as bus:
            asker = SafetyClient(bus, robot, self.timeout)
            answer = asker.decide(state, action, near, scan=scan, known_free=self.known_free)
        figures: dict[str, Any] = {
            "decision": answer.kind,
            "for_clearance": answer.for_clearance,
            "plan": answer.plan.tolist(),
            "tube": {"center": answer.tube_center.tolist(), "half_width": answer.tube_half_width.tolist()},
            "margin": answer.margin,
            "at_least": answer.at_least,
            "time_ms": answer.time_ms,
            "model": answer.model,
            "reason": answer.reason,
            "verified": answer.verified,
            "bound": answer.bound,
        }
        if self.json:
            say_json(figures)
            return 0
        why = " for clearance: the proposal is verified too," if answer.for_clearance else ""
        console.print(f"[bold]{answer.kind}[/]{why} {escape(answer.reason)}")
        console.print(describe_verification(answer.verified, answer.bound), markup=False)
        shown = StackingTable(**PLAIN)
        for column in ("period", *robot.action, "center [m]", "± [m]"):
            shown.add_column(column)
        for k, (u, c, h) in enumerate(
            zip(figures["plan"], figures["tube"]["center"], figures["tube"]["half_width"], strict=True)
        ):
            shown.add_row(str(k), *(f"{value:.4f}" for value in u), _numbers(c), _numbers(h))
        console.print(shown)
        margin = f"{'> ' if answer.at_least else ''}{answer.margin:.4f} m"
        console.print(f"margin {margin}, {answer.time_ms:.2f} ms in decide, model {answer.model}")
        return 0


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


@dataclass(frozen=True)
class Status:
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    wait: float = 1.5
    """s to listen: every living process speaks once a second."""
    json: bool = False

    def run(self) -> int:
        processes: dict[str, Any] = {}
        learners: dict[str, Any] = {}

        def health(sample: Sample) -> None:
            said = sample.message()
            processes[said.process] = {"pid": said.pid, **dict(said.figures), **dict(said.notes)}

        def learner(sample: Sample) -> None:
            said = sample.message()
            names = [f.name for f in said.DESCRIPTOR.fields if f.name not in ("header", "robot")]
            learners[said.robot] = {name: getattr(said, name) for name in names}

        with Bus(self.endpoints.bus(), f"viewer.status-{time.time_ns() % 10**6}") as bus:
            bus.subscribe(HEALTH, health)
            bus.subscribe(LEARNER, learner)
            time.sleep(self.wait)
            alive = sorted(name for name in bus.living() if name != bus.source)
        if self.json:
            say_json({"alive": alive, "processes": processes, "learners": learners})
            return 0
        table = StackingTable(**PLAIN)
        for column in ("process", "state", "what it says"):
            table.add_column(column)
        for name in sorted({*alive, *processes}):
            table.add_row(name, "[green]alive[/]" if name in alive else "[red]gone[/]", said(processes.get(name, {})))
        console.print(table)
        for robot, figures in learners.items():
            console.print(
                f"learning {robot}: {figures['steps']} steps, {figures['updates']} updates, "
                f"{figures['steps_per_s']:.0f} steps/s, {figures['updates_per_s']:.0f} updates/s, "
                f"critic loss {figures['critic_loss']:.3f}, actor loss {figures['actor_loss']:.3f}, "
                f"weights {figures['weights_version']}"
            )
        return 0


def said(told: dict[str, Any]) -> str:
    """A process's figures and notes that are not zero or empty; --json has all, and the counts per channel."""
    shown = {name: value for name, value in told.items() if value and "/" not in name}
    return escape(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown.items()))
