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
        writers = {"csv": self._csv, "minari": self._minari, "foxglove": self._foxglove, "tlog": self._tlog}
        formats = [name for name in writers if getattr(self, name) is not None]
        if not formats:
            raise ValueError(
                f"no format to export to: give one or more of {', '.join(f'--{name}' for name in writers)}"
            )
        figures: dict[str, Any] = {}
        for name in formats:
            with under_way(f"writing {getattr(self, name)}"):
                figures[name] = writers[name]()
        counts = {
            written["path"]: ", ".join(f"{count} {unit}" for unit, count in written.items() if unit != "path")
            for written in figures.values()
        }
        print_result(self.json, figures, *(f"{path}: {text}" for path, text in counts.items()))
        return 0

    def _csv(self) -> dict[str, Any]:
        from brakeline.errors import ExportError
        from brakeline.logs.log_export import to_csv

        assert self.csv is not None
        robot = robot_with_task(self.robot)
        self.csv.parent.mkdir(parents=True, exist_ok=True)
        try:
            with self.csv.open("w", newline="") as file:
                return {"path": str(self.csv), "steps": to_csv(list(self.logs), robot, file)}
        except ExportError:
            if self.csv.is_file():  # it has a header alone; a pipe has no file to delete
                self.csv.unlink()
            raise

    def _minari(self) -> dict[str, Any]:
        from brakeline.logs.minari_export import to_minari

        assert self.minari is not None
        return to_minari(list(self.logs), robot_with_task(self.robot), self.minari)

    def _tlog(self) -> dict[str, Any]:
        from brakeline.logs.log_export import to_tlog

        assert self.tlog is not None
        with self.tlog.open("wb") as file:
            return {"path": str(self.tlog), "frames": to_tlog(list(self.logs), file)}

    def _foxglove(self) -> dict[str, Any]:
        from brakeline.logs.log_export import to_foxglove

        assert self.foxglove is not None
        return {"path": str(self.foxglove), "messages": to_foxglove(list(self.logs), self.foxglove)}
