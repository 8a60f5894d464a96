"""Implement `brakeline robot`: write, check or show the description of a robot."""

from __future__ import annotations

import math
import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from brakeline.deploy.commands.command_output import errors, print_json, print_result
from brakeline.deploy.commands.common_options import Json, LogReadOptions, Unprefixed
from brakeline.deploy.data.description_summary import summary
from brakeline.errors import BadDescription, MissingExtra, NoArena, NoSource, UnknownTask
from brakeline.logs.stacking_table import plain_table
from brakeline.messaging.description_model import NAME
from brakeline.messaging.robot import robot_named
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import RobotWithTask, Task, robot_maybe_with_task

if TYPE_CHECKING:
    from brakeline.deploy.data.log_options import LogOptions

NOT_SHOWN = (
    "the log does not show the body, `sight` and the measurement errors (`error`): the template's values remain. "
    "Measure the robot, and replace them"
)


@dataclass(frozen=True)
class RobotCommand:
    """The options of `brakeline robot`."""

    action: Annotated[Literal["new", "check", "show"], tyro.conf.Positional]
    """Choose what to do: new writes a description with comments, check lists all mistakes in a description, and show
    prints the values that follow from it, such as the order and the units of state and inputs."""
    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Write or read this description (.toml). With check and show, you may name a robot that comes with the program."""
    from_: Annotated[tuple[Path, ...], tyro.conf.arg(name="from")] = ()
    """With new, infer values from these logs of one robot (CSV, Parquet, ROS bags, logs of autopilots). The log of a
    run contains the whole description."""
    map: tuple[str, ...] = ()
    """With --from, name the coordinates, the inputs and the time, each with its place in the log: NAME=TABLE/FIELD, or
    NAME=COLUMN for a file of columns. The command then reads only the named columns of this file. The name of an input
    begins with `command `."""
    reading: Unprefixed[LogReadOptions] = field(default_factory=LogReadOptions)
    json: Json = False

    def run(self) -> int:
        """Do the action. Returns the exit status; 1 if the description has mistakes.

        Raises:
            ValueError: an option would do nothing.
        """
        words = self.reading.options(self.map).words()
        if self.action != "new" and (self.from_ or words):
            raise ValueError(f"--from, --map, --unit and --topics are for `robot new`, not for {self.action}")
        if words and not self.from_:
            raise ValueError(f"{words}: these options are for reading a log; name it with --from")
        return {"new": self._new, "check": self._check, "show": self._show}[self.action]()

    def _new(self) -> int:
        path = Path(self.file)
        if path.suffix != ".toml" or not NAME.fullmatch(path.stem):
            raise ValueError(f"{self.file}: a description is a file NAME.toml, NAME of letters, digits, '_' and '-'")
        if path.exists():
            raise ValueError(
                f"{path} exists: check it with `brakeline robot check {shlex.quote(self.file)}`, delete it, or choose "
                "another name"
            )
        text = (ROBOTS_FOLDER / "template.txt").read_text("utf-8").replace('"NAME"', f'"{path.stem}"')
        notes: tuple[str, ...] = ()
        options = self.reading.options(self.map)
        if self.from_:
            text, notes = _from_logs(self.from_, text, path.stem, options)
        path.write_bytes(text.encode())  # TOML is UTF-8 in any locale
        following = f"{path}: fill it in, then `brakeline robot check {shlex.quote(self.file)}`"
        if words := options.words():
            logs = shlex.join(map(str, self.from_))
            following += f" and `brakeline import {logs} --robot {shlex.quote(self.file)} {words}`"
        print_result(self.json, {"file": str(path), "notes": list(notes)}, *notes, following)
        return 0

    def _check(self) -> int:
        try:
            robot = robot_named(self.file)
        except BadDescription as error:
            return self._refuse(error.problems, str(error))
        remarks, tasked, collect = summary(robot)["remarks"], robot_maybe_with_task(self.file), ""
        if isinstance(tasked, RobotWithTask):
            problems, missing = _code_problems(tasked.task)
            problems += _arena_problems(tasked)
            remarks, collect = [*remarks, *missing], f", or `brakeline collect {shlex.quote(self.file)}`"
            if problems:
                lines = "".join(f"\n  {place}: {what}" for place, what in problems)
                return self._refuse(problems, f"{robot.name}: the task has mistakes:{lines}")
        print_result(
            self.json,
            {"file": self.file, "problems": [], "remarks": remarks},
            f"{robot.name}: {len(robot.state)} coordinates, {len(robot.action)} inputs, no mistake",
            *(f"  {line}" for line in (*remarks, _task_text(self.file))),
            f"next: `brakeline import LOG --robot {shlex.quote(self.file)}`{collect}",
        )
        return 0

    def _refuse(self, problems: Sequence[tuple[str, str]], text: str) -> int:
        """Print the mistakes, and return the exit status."""
        if self.json:
            print_json({"file": self.file, "problems": problems})
        else:
            errors.print(text, markup=False)
        return 1

    def _show(self) -> int:
        robot = robot_named(self.file)
        values = summary(robot)
        rows = [(f"input {label}", _input_text(one)) for label, one in values["inputs"].items()]
        for name, value in values.items():
            if name != "inputs":
                text = "\n".join(value) if isinstance(value, list) else "not known" if value is None else value
                text = f"{text:g}" if isinstance(text, float) else str(text)
                rows.append((_label(name), text))
        print_result(self.json, values, plain_table((), rows))
        return 0


def _input_text(one: dict[str, Any]) -> str:
    slew = f"slew: {one['slew']:g}, " if math.isfinite(one["slew"]) else ""
    return f"{one['low']:g} to {one['high']:g}, {slew}stop: {one['stop']}"


def _label(name: str) -> str:
    """Return a figure's name for people, with its unit in brackets: `period [s]` for `period_s`."""
    if name == "way_to_a_stop_m":
        return "way to a stop, without lag [m]"
    words, _, last = name.replace("_", " ").rpartition(" ")
    return f"{words} [{last}]" if last in ("s", "m") else f"{words} {last}".strip()


def _code_problems(task: Task) -> tuple[list[tuple[str, str]], list[str]]:
    """Load the code that a task names. Return (field, mistake) pairs, and remarks on what cannot be loaded here."""
    problems, missing = list[tuple[str, str]](), dict[str, None]()
    policies = {f"policies.{name}": place for name, place in task.policies.items()}
    for field_name, place in {"simulator": task.simulator, "senses": task.senses, **policies}.items():
        try:
            if not callable(task.code(place)):
                problems.append((field_name, f"{place!r} is neither a function nor a class"))
        except UnknownTask as error:
            problems.append((field_name, str(error)))
        except MissingExtra as error:
            missing[f"the code of the task was not checked: {error}"] = None
    return problems, list(missing)


def _arena_problems(robot: RobotWithTask) -> list[tuple[str, str]]:
    """Draw each arena of a task. Return (field, mistake) pairs for those in which the robot has no path to its goal."""
    from brakeline.sim.arena_generator import draw_arena

    problems = list[tuple[str, str]]()
    for name in robot.task.arenas:
        try:
            draw_arena(name, np.random.default_rng(0), robot)
        except NoArena as error:
            problems.append((f"arenas.{name}", str(error)))
    return problems


def _task_text(name: str) -> str:
    robot = robot_maybe_with_task(name)
    if not robot.position_dim:
        return "no position: the filter keeps its limits in joint space, without obstacles and tasks"
    if not isinstance(robot, RobotWithTask):
        return "no task file beside it: you can certify and filter; to train, write NAME.task.toml (docs/your_robot.md)"
    task = robot.task
    return f"its task: {task.observation_dim} observed values, arenas {', '.join(task.arenas)}"


def _from_logs(sources: tuple[Path, ...], template: str, name: str, options: LogOptions) -> tuple[str, tuple[str, ...]]:
    """Return the text of a description, and notes on what the logs do not show.

    Raises:
        NoSource: a log cannot be used, or does not show enough for a description without mistakes.
        LogError: the log of a run cannot be read.
    """
    from brakeline.deploy.data.description_template import delay_notes, fill_template
    from brakeline.deploy.data.embedded_description import read_embedded_description
    from brakeline.deploy.data.importer import own_log, tables_of
    from brakeline.deploy.data.schema_inference import infer_schema, without_inputs

    if any(map(own_log, sources)):
        if len(sources) > 1 or options.words():
            raise NoSource(
                "the log of a run contains the whole description: give one such log alone, without --map, --unit and "
                "--topics"
            )
        return read_embedded_description(sources[0], name), ()
    names = ", ".join(source.name for source in sources)
    schema = infer_schema(*(tables_of(source, options) for source in sources), options=options)
    problems = ""
    for one in (schema, without_inputs(schema)):
        text = fill_template(template, one, names)
        try:
            robot_from_description(tomllib.loads(text), name)
        except (BadDescription, tomllib.TOMLDecodeError) as error:
            problems = str(error)
        else:
            return text, (*one.notes, *delay_notes(one), NOT_SHOWN)
    reasons = "\n  ".join((*schema.notes, problems))
    raise NoSource(
        f"{names}: no description without mistakes follows from it. Name the columns with --map, or drive so that "
        f"every input takes several values and the robot moves and turns:\n  {reasons}"
    )
