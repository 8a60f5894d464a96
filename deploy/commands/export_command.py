"""Implement `brakeline export`: write a log in the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brakeline.deploy.commands.command_output import print_result
from brakeline.deploy.commands.common_options import LATEST, Json, Logs, Quiet
from brakeline.deploy.progress import under_way
from brakeline.messaging.task import robot_with_task


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
    robot: str = "ground"
    """With --csv and --minari, export the steps of this robot. Give its name, or the path of a description (.toml)."""
    quiet: Quiet = False
    json: Json = False

    def run(self) -> int:
        """Write the files. Returns the exit status."""
        from brakeline.logs.log_export import to_foxglove, to_tlog

        figures: dict[str, Any] = {}
        if self.csv is not None:
            with under_way(f"writing {self.csv}"):
                figures["csv"] = self._csv(self.csv)
        if self.minari is not None:
            from brakeline.logs.log_export import to_minari

            with under_way(f"writing {self.minari}"):
                figures["minari"] = to_minari(list(self.logs), robot_with_task(self.robot), self.minari)
        if self.foxglove is not None:
            with under_way(f"writing {self.foxglove}"):
                written = to_foxglove(list(self.logs), self.foxglove)
                figures["foxglove"] = {"path": str(self.foxglove), "messages": written}
        if self.tlog is not None:
            with under_way(f"writing {self.tlog}"), self.tlog.open("wb") as file:
                figures["tlog"] = {"path": str(self.tlog), "frames": to_tlog(list(self.logs), file)}
        if not figures:
            raise ValueError("no format to export to: give one or more of --csv, --minari, --foxglove, --tlog")
        counts = {
            written["path"]: ", ".join(f"{count} {unit}" for unit, count in written.items() if unit != "path")
            for written in figures.values()
        }
        print_result(self.json, figures, *(f"{path}: {text}" for path, text in counts.items()))
        return 0

    def _csv(self, path: Path) -> dict[str, Any]:
        from brakeline.errors import ExportError
        from brakeline.logs.log_export import to_csv

        robot = robot_with_task(self.robot)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with path.open("w", newline="") as file:
                return {"path": str(path), "steps": to_csv(list(self.logs), robot, file)}
        except ExportError:
            if path.is_file():  # it has a header alone; a pipe has no file to delete
                path.unlink()
            raise
