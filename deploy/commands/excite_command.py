"""Implement `brakeline excite`: print or drive the inputs that excite a robot best within a region."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from shlex import quote
from typing import ClassVar

from brakeline.deploy.commands.command_output import print_result
from brakeline.deploy.commands.common_options import Json, Quiet, Robot, Seed
from brakeline.deploy.data import excitation_plan
from brakeline.deploy.data.sources.quantity_names import column_names
from brakeline.deploy.progress import under_way
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import RobotWithTask, robot_with_task


@dataclass(frozen=True)
class ExciteCommand:
    """The options of `brakeline excite`."""

    robot: Robot = "ground"
    keep: tuple[float, float, float, float] = (-2.0, -2.0, 2.0, 2.0)
    """Stay in this region: least x, least y, greatest x, greatest y [m]. Each run starts in the middle of
    the region, and heads along x."""
    minutes: float = 10.0
    """Drive for this long [min]."""
    seed: Seed = 0
    drive: Path | None = None
    """Drive the inputs in the robot's simulator instead of printing them, and record this log (.mcap). The measured
    position then keeps the robot in the region."""
    quiet: Quiet = False
    json: Json = False
    """With --drive, print the result as one JSON object on stdout."""

    above: ClassVar[dict[str, float]] = {"minutes": 0}

    def run(self) -> int:
        """Print or drive the inputs. Returns the exit status."""
        if self.drive is not None:
            return self._drive(robot_with_task(self.robot), self.drive)
        robot = robot_named(self.robot)
        print(",".join(("time", "run", *column_names(robot)[1])))
        for time, run, u in excitation_plan.excitation_rows(robot, self.keep, self.minutes, self.seed):
            print(",".join((f"{time:.9g}", str(run), *(f"{value:.6g}" for value in u))))
        return 0

    def _drive(self, robot: RobotWithTask, path: Path) -> int:
        from brakeline.deploy.run.excitation_run import drive

        with under_way(f"driving {robot.name}", round(60.0 * self.minutes / robot.period)) as advance:
            driven = drive(robot, self.keep, self.minutes, self.seed, path, advance=advance)
        edge = f"{-driven.outside:.2f} m inside the region" if driven.outside <= 0.0 else f"{driven.outside:.2f} m OUT"
        counts = f"{driven.periods} periods in {driven.runs} runs; the body came to {edge}"
        following = f"next: brakeline import LOG {quote(str(path))} --robot {quote(self.robot)}"
        print_result(self.json, asdict(driven), f"{path}: {counts}", following)
        return 0
