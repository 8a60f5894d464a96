"""Implement `brakeline export`: write a log in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brakeline.deploy.commands.command_output import print_damage, print_result
from brakeline.deploy.commands.common_options import LATEST, Json, Logs, Quiet
from brakeline.deploy.progress import under_way
from brakeline.messaging.atomic_files import whole_or_nothing
from brakeline.messaging.task import needs_task

if TYPE_CHECKING:
    from brakeline.logs.reader import Log
    from brakeline.messaging.robot import Robot


@dataclass(frozen=True)
class ExportCommand:
    """The options of `brakeline export`."""

    logs: Logs = (LATEST,)
    csv: Path | None = None
    """Write each step as a line of this CSV file."""
    minari: str | None = None
    """Write the episodes as a local Minari data set with this name, such as brakeline/ground-v0."""
    foxglove: Path | None = None
    """Write an MCAP file with a picture of each step. The log itself has pictures of some steps."""
    tlog: Path | None = None
    """Write each MAVLink frame to this file, which ground stations and pymavlink can read."""
    robot: str = ""
    """With --csv and --minari, export the steps of this robot. Give its name, or the path of a description (.toml).
    Defaults to the only robot of the log; if it has several, to ground."""
    quiet: Quiet = False
    json: Json = False

    def run(self) -> int:
        """Write the files. Returns the exit status."""
        from brakeline.logs.reader import Damage, open_log, refuse_to_overwrite_log

        for path in filter(None, (self.csv, self.tlog)):
            refuse_to_overwrite_log(path)
        figures, damage = dict[str, Any](), Damage()
        writers: dict[str, Callable[[Log, Any], dict[str, Any]]] = {
            **{"csv": self._csv, "minari": self._minari, "foxglove": self._foxglove, "tlog": self._tlog}
        }
        for name, write in writers.items():
            if (target := getattr(self, name)) is not None:
                log = open_log(self.logs)
                with under_way(f"writing {target}"):
                    figures[name] = write(log, target)
                damage = log.damage
        if not figures:
            raise ValueError("no format to export to: give one or more of --csv, --minari, --foxglove, --tlog")
        counts = {
            written["path"]: ", ".join(f"{count} {unit}" for unit, count in written.items() if unit != "path")
            for written in figures.values()
        }
        print_damage(damage)
        print_result(self.json, figures | asdict(damage), *(f"{path}: {text}" for path, text in counts.items()))
        return 0

    def _robot_of(self, log: Log) -> Robot:
        """Return the robot whose steps are exported. Raises BadData if its description names other columns."""
        from brakeline.deploy.data.run_dataset import check_logs
        from brakeline.logs.log_export import robot_of_log

        robot = robot_of_log(log, self.robot)
        check_logs(self.logs, robot)
        return robot

    def _csv(self, log: Log, out: Path) -> dict[str, Any]:
        from brakeline.logs.log_export import to_csv

        robot = self._robot_of(log)
        with whole_or_nothing(out) as path, path.open("w", newline="") as file:
            return {"path": str(out), "steps": to_csv(log, robot, file)}

    def _minari(self, log: Log, name: str) -> dict[str, Any]:
        from brakeline.logs.log_export import to_minari

        return to_minari(log, needs_task(self._robot_of(log)), name)

    def _foxglove(self, log: Log, out: Path) -> dict[str, Any]:
        from brakeline.logs.log_export import to_foxglove

        return {"path": str(out), "messages": to_foxglove(log, out)}

    def _tlog(self, log: Log, out: Path) -> dict[str, Any]:
        from brakeline.logs.log_export import to_tlog

        with whole_or_nothing(out) as path, path.open("wb") as file:
            return {"path": str(out), "frames": to_tlog(log, file)}
