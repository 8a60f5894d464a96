"""`brakeline robot`: a robot's description: a new one, a check, a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.markup import escape

from brakeline.deploy.commands.common_options import console, errors, say_json
from brakeline.deploy.data.description_plot import picture, summary
from brakeline.logs.console_tables import PLAIN, StackingTable
from brakeline.messaging.robot import ROBOTS_FOLDER, robot_named
from brakeline.messaging.robot_description import NAME, BadDescription
from brakeline.messaging.task import RobotWithTask, robot_maybe_with_task


@dataclass(frozen=True)
class RobotCommand:
    action: Annotated[Literal["new", "check", "show"], tyro.conf.Positional]
    """new: write a commented description; check: tell every mistake; show: what it amounts to."""
    file: Annotated[str, tyro.conf.Positional]
    """The description (.toml), or the name of a robot that comes with the program."""
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """With new: fill in what this log tells (CSV, Parquet, ROS 2 bags, autopilots' logs; that of a run tells all)."""
    picture: Path | None = None
    """Draw the body and the stop into this image."""
    json: bool = False

    def run(self) -> int:
        return {"new": self._new, "check": self._check, "show": self._show}[self.action]()

    def _new(self) -> int:
        path = Path(self.file)
        if path.suffix != ".toml" or not NAME.fullmatch(path.stem):
            raise ValueError(f"{self.file}: a description is a file NAME.toml, NAME of letters, digits, '_' and '-'")
        if path.exists():
            raise ValueError(f"{path} exists: `brakeline robot check {path}`")
        template = (ROBOTS_FOLDER / "template.txt").read_text().replace('"NAME"', f'"{path.stem}"')
        notes: tuple[str, ...] = ()
        if self.from_ is not None:
            template, notes = _from_log(self.from_, template, path.stem)
        path.write_text(template)
        if self.json:
            say_json({"file": str(path), "notes": list(notes)})
            return 0
        for note in notes:
            console.print(note, markup=False)
        console.print(f"{path}: fill it in, then `brakeline robot check {path}`")
        return 0

    def _check(self) -> int:
        try:
            robot = robot_named(self.file)
        except BadDescription as error:
            if self.json:
                say_json({"file": self.file, "problems": [list(problem) for problem in error.problems]})
            else:
                errors.print(str(error), markup=False)
            return 1
        found = summary(robot)
        if self.json:
            say_json({"file": self.file, "problems": [], "remarks": found["remarks"]})
            return 0
        console.print(f"{robot.name}: {len(robot.state)} coordinates, {len(robot.action)} inputs, no mistake")
        for remark in found["remarks"]:
            console.print(f"  {remark}", markup=False)
        console.print(f"  {_task(self.file)}", markup=False)
        console.print(f"next: `brakeline import LOG --robot {self.file}`, or `brakeline collect {self.file}`")
        return 0

    def _show(self) -> int:
        robot = robot_named(self.file)
        found = summary(robot)
        if self.picture is not None:
            picture(robot, self.picture)
            found["picture"] = str(self.picture)
        if self.json:
            say_json(found)
            return 0
        table = StackingTable(show_header=False, **PLAIN)
        for label, one in found.pop("inputs").items():
            table.add_row(escape(f"input {label}"), f"{one['low']:g} to {one['high']:g}, stop: {one['stop']}")
        for name, value in found.items():
            shown = "\n".join(value) if isinstance(value, list) else f"{value:g}" if isinstance(value, float) else value
            table.add_row(name.replace("_", " "), escape(str(shown)))
        console.print(table)
        return 0


def _task(name: str) -> str:
    robot = robot_maybe_with_task(name)
    if not isinstance(robot, RobotWithTask):
        return "no task beside it: enough to certify and to filter; to train, write NAME.task.toml (docs/your_robot.md)"
    task = robot.task
    return f"its task: {task.observation_dim} observed values, arenas {', '.join(task.arenas)}"


def _from_log(source: Path, template: str, name: str) -> tuple[str, tuple[str, ...]]:
    """A description's text, and what the log could not tell of it. Raises NoSource, LogError."""
    from brakeline.deploy.data.description_template import draft
    from brakeline.deploy.data.embedded_description import carried
    from brakeline.deploy.data.importer import own_log, tables_of
    from brakeline.deploy.data.schema_inference import told

    if own_log(source):
        return carried(source, name), ()
    found = told(tables_of(source))
    return draft(template, found, source.name), found.notes
