"""Implement `brakeline import`: make a data set from logs of any robot."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro
from rich.markup import escape
from rich.text import Text

from brakeline.deploy.commands.command_output import errors, print_result
from brakeline.deploy.commands.common_options import Json, LogReadOptions, Quiet, Unprefixed
from brakeline.deploy.data.resample import HOLD
from brakeline.logs.stacking_table import PLAIN, StackingTable

if TYPE_CHECKING:
    from brakeline.deploy.data.coverage import Coverage


@dataclass(frozen=True)
class ImportCommand:
    """The options of `brakeline import`."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG ...")]
    """Import these logs: CSV, JSON, Parquet, ROS bags, ArduPilot or PX4 logs, or Brakeline runs (docs/data.md)."""
    robot: str = "ground"
    """Read the log of this robot. Give its name, or the path of a description (.toml)."""
    out: Path | None = None
    """Write the data set to this file. Defaults to the data set in use, data/ROBOT/record.safetensors."""
    map: tuple[str, ...] = ()
    """Read a coordinate, an input or the time from this place of the log, if the command does not find it by its name.
    Write NAME=TABLE/FIELD, or NAME=COLUMN for a file of columns."""
    delay: float = 0.0
    """Add this time to the stamps of the inputs, if these are too early [s]. If they are too late, give a negative
    time. The report says how long after its inputs the robot moves."""
    hold: float = HOLD
    """Let an input count for this time after its last message [s]."""
    reading: Unprefixed[LogReadOptions] = field(default_factory=LogReadOptions)
    picture: Path | None = None
    """Draw the recorded driving into this image (.png)."""
    quiet: Quiet = False
    json: Json = False

    above: ClassVar[dict[str, float]] = {"hold": 0.0}

    def run(self) -> int:
        """Import the logs. Returns the exit status; 1 if the data can't give a model set."""
        from brakeline.deploy.data import importer
        from brakeline.deploy.data.build_lock import folder_lock
        from brakeline.deploy.data.coverage import coverage, draw_coverage
        from brakeline.deploy.data.data_paths import record_path
        from brakeline.messaging.robot import robot_named
        from brakeline.safety.model.dataset import Dataset

        if self.out is not None:
            Dataset.check_out(self.out)
        robot = robot_named(self.robot)
        options = self.reading.options(self.map)
        imported = importer.import_sources(self.sources, robot, options, self.delay, self.hold)
        covered = coverage(imported.data)
        path = self.out or record_path(robot)
        if self.picture is not None:
            draw_coverage(imported.data, covered, self.picture)
        if not covered.refused:
            with folder_lock(path.parent):
                imported.data.save(path)
        figures: dict[str, Any] = {"path": None if covered.refused else str(path), "digest": imported.data.digest()}
        figures |= {"report": asdict(imported.report), "coverage": asdict(covered), "refused": covered.refused}
        lengths = (
            f"{covered.windows} windows of a plan's length ({robot.horizon} periods; they overlap), {covered.plans} of "
            "them brake as the filter's plans do"
        )
        counts = f"{imported.data.periods} periods in {imported.report.trajectories} trajectories"
        missing = [Text.from_markup(f"[yellow]missing:[/] {escape(text)}") for text in covered.missing]
        data = [] if self.out is None else ["--data", str(path)]
        next_command = shlex.join(["brakeline", "certify", self.robot, *data, "--use"])
        following = [] if covered.refused else [f"{path}: {counts}", f"next: {next_command}"]
        print_result(self.json, figures, *imported.report.notes, coverage_table(covered), lengths, *missing, *following)
        if covered.refused and not self.json:
            errors.print(f"[red]refused:[/] no model set can be made of this: {escape(covered.refused)}")
        return int(bool(covered.refused))


def coverage_table(covered: Coverage) -> StackingTable:
    """Return a table of the ranges that the data cover."""
    table = StackingTable(**PLAIN)
    for column in ("", "least", "most", "bounds", "covered"):
        table.add_column(column, justify="left" if not column else "right")
    for one in covered.seen:
        bounds = f"{one.low:g} to {one.high:g} {one.unit}"
        table.add_row(one.name, f"{one.least:.3g}", f"{one.most:.3g}", bounds, f"{one.share:.0%}")
    table.add_row("stops", str(covered.stops))
    return table
