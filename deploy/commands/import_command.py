"""`brakeline import` and `brakeline excite`: data of a robot that somebody drives."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from brakeline.deploy.commands.common_options import Robot, console, errors, say_json
from brakeline.deploy.data import excitation_plan, importer
from brakeline.deploy.data.build_lock import alone
from brakeline.deploy.data.coverage import Coverage, coverage
from brakeline.deploy.data.coverage_plot import draw
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.data.resample import HOLD
from brakeline.deploy.data.sources.quantity_names import columns_of
from brakeline.deploy.progress import under_way
from brakeline.logs.console_tables import PLAIN, StackingTable
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import RobotWithTask, robot_with_task


@dataclass(frozen=True)
class Import:
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """CSV, Parquet, ROS 2 bags, ArduPilot's .bin and .tlog, PX4's .ulg, logs of runs (docs/data.md)."""
    robot: str = "ground"
    """Name, or path of a description (.toml)."""
    out: Path | None = None
    """File; default: the data set in use (data/ROBOT/record.safetensors), replaced."""
    map: tuple[str, ...] = ()
    """NAME=TABLE/FIELD: where a coordinate or input is, if not where it usually is."""
    delay: float = 0.0
    """s by which inputs are stamped too early; the report says how much later than its inputs the robot moves."""
    hold: float = HOLD
    """s that an input counts for after its last message."""
    picture: Path | None = None
    """PNG of what was driven."""
    json: bool = False

    def run(self) -> int:
        robot = robot_named(self.robot)
        made = importer.bring(self.sources, robot, self.map, self.delay, self.hold)
        told = coverage(made.data)
        path = self.out or record_path(robot)
        if self.picture is not None:
            draw(made.data, told, self.picture)
        if not told.refused:
            with alone(path.parent):
                made.data.save(path)
        figures = {"path": None if told.refused else str(path), "digest": made.data.digest()}
        if self.json:
            say_json(figures | {"report": asdict(made.report), "coverage": asdict(told), "refused": told.refused})
            return int(bool(told.refused))
        for note in made.report.notes:
            console.print(note, markup=False)
        console.print(covered(told))
        for text in told.missing:
            console.print(f"[yellow]missing:[/] {escape(text)}")
        if told.refused:
            errors.print(f"[red]refused:[/] no model set can be made of this: {escape(told.refused)}")
            return 1
        console.print(f"{path}: {made.data.periods} periods in {made.report.trajectories} trajectories", markup=False)
        console.print(f"next: brakeline certify {path} --use", markup=False)
        return 0


def covered(told: Coverage) -> StackingTable:
    shown = StackingTable(**PLAIN)
    for column in ("", "least", "most", "bounds", "covered"):
        shown.add_column(column, justify="left" if not column else "right")
    for one in told.seen:
        bounds = f"{one.low:g} to {one.high:g} {one.unit}"
        shown.add_row(one.name, f"{one.least:.3g}", f"{one.most:.3g}", bounds, f"{one.share:.0%}")
    shown.add_row("stops", str(told.stops))
    shown.add_row("windows", f"{told.plans} of plans", f"{told.windows} free")
    return shown


@dataclass(frozen=True)
class Excite:
    robot: Robot = "ground"
    keep: tuple[float, float, float, float] = (-2.0, -2.0, 2.0, 2.0)
    """x and y, least and most [m], that the robot stays within; each run begins in the middle, along x."""
    minutes: float = 10.0
    seed: int = 0
    drive: Path | None = None
    """Drive them in the robot's simulator instead of printing them, and record that into this log (.mcap); it keeps to
    the region by where the robot is measured to be."""
    json: bool = False
    """With --drive: one JSON object on stdout."""

    def run(self) -> int:
        robot = robot_named(self.robot)
        if self.drive is not None:
            return self._drive(robot_with_task(self.robot), self.drive)
        print(",".join(("time", "run", *columns_of(robot)[1])))
        for row in excitation_plan.rows(robot, self.keep, self.minutes, self.seed):
            print(",".join((f"{row.time:.9g}", str(row.run), *(f"{value:.6g}" for value in row.input))))
        return 0

    def _drive(self, robot: RobotWithTask, path: Path) -> int:
        from brakeline.deploy.run.excitation_run import drive

        with under_way(f"driving {robot.name}", round(60.0 * self.minutes / robot.period)) as advance:
            done = 0

            def each(periods: int) -> None:
                nonlocal done
                advance(periods - done)
                done = periods

            driven = drive(robot, self.keep, self.minutes, self.seed, path, each=each)
        if self.json:
            say_json(asdict(driven))
            return 0
        edge = f"{-driven.outside:.2f} m inside the region" if driven.outside <= 0.0 else f"{driven.outside:.2f} m OUT"
        console.print(f"{path}: {driven.periods} periods in {driven.runs} runs; the body came to {edge}", markup=False)
        console.print(f"next: brakeline import LOG {path} --robot {self.robot}", markup=False)
        return 0
