"""Implement `brakeline query`: ask a running safety service for one decision."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import ClassVar

import numpy as np
from rich.markup import escape
from rich.text import Text

from brakeline.deploy.commands.command_output import print_result
from brakeline.deploy.commands.common_options import BusOptions, Json, Robot, Unprefixed
from brakeline.errors import BadScan
from brakeline.logs.stacking_table import StackingTable, plain_table
from brakeline.messaging.bus import Bus
from brakeline.messaging.labels import split_label
from brakeline.messaging.obstacle import KINDS, Obstacle
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import Array, robot_named
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import RangeMeasurement
from brakeline.messaging.stated_share import describe_verification
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.service.client import SafetyClient
from brakeline.safety.service.filter_client import Answer

# Attributes of an answer that --json prints.
SHOWN = (
    *("kind", "action", "plan", "tube_center", "tube_half_width", "margin", "at_least", "for_clearance", "reason"),
    *("verified", "bound", "model", "time_ms"),
)
NOTHING = 1e-9  # an input that is smaller counts as zero
OBSTACLE_FORMS = {  # by number of position coordinates
    2: "cylinder X Y RADIUS | box X Y LENGTH WIDTH [YAW] | wall X Y YAW",
    3: "cylinder X Y Z RADIUS HEIGHT | sphere X Y Z RADIUS | box X Y Z LENGTH WIDTH HEIGHT [YAW] | wall X Y Z YAW",
}


@dataclass(frozen=True)
class QueryCommand:
    """The options of `brakeline query`."""

    robot: Robot = "ground"
    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    state: tuple[float, ...] = ()
    """Ask about this measured state, in the order and the units that `brakeline robot show ROBOT` lists. Defaults to
    rest at the origin."""
    action: tuple[float, ...] = ()
    """Propose this action, in the order and the units that `brakeline robot show ROBOT` lists. Defaults to the highest
    inputs."""
    obstacle: str = ""
    """Describe the obstacles [m, rad], separated by commas: "cylinder X Y RADIUS, box X Y LENGTH WIDTH YAW, wall X Y
    YAW". In space, Z follows Y, a cylinder and a box end with their HEIGHT before the YAW, and there is "sphere X Y Z
    RADIUS"."""
    scan: Path | None = None
    """Read a scan from this JSON file, {"ranges": [...], "angles": [...], "pose": [0, 0, 0], ...}: the fields of Scan,
    or in the air of RangeImage (see docs/perception.md). Space that the scan does not show to be free counts as
    occupied."""
    known_free: bool = False
    """Declare that all space outside the obstacles is free. Give it if you give neither --obstacle nor --scan."""
    acceleration_age: float = 0.0
    """The state holds the horizontal acceleration of this long ago [s]."""
    timeout: float = 1.0
    """Wait this long for the answer [s]."""
    json: Json = False

    above: ClassVar[dict[str, float]] = {"timeout": 0}
    least: ClassVar[dict[str, float]] = {"acceleration_age": 0}

    def run(self) -> int:
        """Ask, and print the decision. Returns the exit status."""
        robot = robot_named(self.robot)
        parts = (part.split() for part in self.obstacle.split(",") if part.strip())
        obstacles = [parse_obstacle(tuple(words), robot.position_dim) for words in parts]
        if not (obstacles or self.scan or self.known_free or not robot.position_dim):
            raise ValueError("nothing is known of the space around the robot: give --obstacle, --scan or --known-free")
        state = self.state or (0.0,) * robot.state_dim
        action = self.action or robot.action_high
        scan = None if self.scan is None else load_scan(self.scan, robot.position_dim)
        with Bus(self.endpoints.bus(), f"client.query-{time.time_ns() % 10**6}") as bus:
            client = SafetyClient(bus, robot, self.timeout, self.acceleration_age)
            answer = client.decide(state, action, obstacles, scan=scan, known_free=self.known_free)
        figures = {name: getattr(answer, name) for name in SHOWN}
        figures |= {name: value.tolist() for name, value in figures.items() if isinstance(value, np.ndarray)}
        clearance = " for clearance: the proposal is verified too," if answer.for_clearance else ""
        margin = f"{'> ' if answer.at_least else ''}{answer.margin:.4f}{' m' if robot.position_dim else ''}"
        print_result(
            self.json,
            figures,
            Text.from_markup(f"[bold]{answer.kind}[/]{clearance} {escape(answer.reason)}".rstrip()),
            proposal(robot.action, action, given=bool(self.action)),
            "execute " + ", ".join(map(quantity, robot.action, answer.action)),
            describe_verification(answer.verified, answer.bound),
            plan_table(answer, robot.action),
            f"margin {margin}, {answer.time_ms:.2f} ms in decide, model {answer.model}",
        )
        return 0


def proposal(inputs: tuple[str, ...], action: Sequence[float], given: bool) -> str:
    """Return a proposed action as text. given: whether the user gave it; the default is easily overlooked."""
    default = "" if given else " (the highest inputs; propose others with --action)"
    return "proposed " + ", ".join(map(quantity, inputs, action)) + default


def plan_table(answer: Answer, inputs: tuple[str, ...]) -> StackingTable:
    """Return a table of an answer's plan, with its tube. The rivals predict no tube: its columns are then left out."""
    tube = {"center [m]": answer.tube_center, "± [m]": answer.tube_half_width} if len(answer.tube_center) else {}
    rows = [
        (str(k), *(f"{value:.4f}" for value in values), *(_numbers(boxes[k]) for boxes in tube.values()))
        for k, values in enumerate(answer.plan)
    ]
    return plain_table(("period", *inputs, *tube), rows)


def quantity(name: str, value: float) -> str:
    """Return an input as text: `speed 0.25 m/s` for the name `speed [m/s]`."""
    word, unit = split_label(name)
    shown = value if abs(value) > NOTHING else 0.0
    return f"{word} {shown:.4g} {unit}".rstrip()


def parse_obstacle(words: tuple[str, ...], dim: int) -> Obstacle:
    """Parse an obstacle: kind, position, sizes, and the yaw of a box or wall if one number is left.

    Args:
        words: kind and numbers.
        dim: number of position coordinates, 2 or 3; 0 for a robot without a position, which has no obstacles.

    Raises:
        ValueError: the words are no obstacle; the message says how to write one.
    """
    if not dim:
        raise ValueError("a robot without a position has no obstacles, only limits: leave out --obstacle")
    kind, form = words[0] if words else "", f"an obstacle is: {OBSTACLE_FORMS[dim]}"
    if kind not in KINDS:
        raise ValueError(f"{kind!r}: {form}")
    sizes = {"box": dim, "cylinder": dim - 1, "sphere": 1, "wall": 0}[kind]
    try:
        values = [float(number) for number in words[1:]]
    except ValueError:
        values = []
    if len(values) not in (dim + sizes, dim + sizes + 1):
        raise ValueError(f"{' '.join(words)}: {form}")
    yaw = values[dim + sizes] if len(values) > dim + sizes else 0.0
    return Obstacle(kind, tuple(values[:dim]), tuple(values[dim : dim + sizes]), yaw)


def load_scan(path: Path, dim: int) -> RangeMeasurement:
    """Load a scan from a JSON file: the fields of a `Scan` on the ground (dim 2), of a `RangeImage` in the air (dim 3).

    Raises:
        BadScan: the file holds no such scan.
        OSError: the file can't be read.
    """
    kind = Scan if dim == 2 else RangeImage
    names = [field.name for field in fields(kind) if field.name != "followed"]
    try:
        values = parse_json(path.read_text("utf-8-sig"))
        if not isinstance(values, dict) or not values.keys() <= set(names):
            raise BadScan(f"{path}: not a {kind.__name__}, which is a JSON object of {', '.join(names)}")
        return kind(**values)
    except (TypeError, ValueError) as error:  # no JSON, a field is missing, or a value is no number
        raise error if isinstance(error, BadScan) else BadScan(f"{path}: not a {kind.__name__}: {error}") from error


def _numbers(values: Array) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
