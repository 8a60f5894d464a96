"""`brakeline export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from brakeline.deploy.commands.common_options import LATEST, console, say_json
from brakeline.deploy.progress import under_way
from brakeline.messaging.task import robot_with_task


@dataclass(frozen=True)
class Export:
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (LATEST,)
    """Log files, or run folders."""
    csv: Path | None = None
    """Every step as a line of this file."""
    minari: str | None = None
    """The episodes as a local Minari data set of this name, e.g. brakeline/ground-v0."""
    foxglove: Path | None = None
    """An MCAP file with a picture of every step; the log itself has pictures of some."""
    tlog: Path | None = None
    """Every MAVLink frame, as ground stations and pymavlink read it."""
    robot: str = "ground"
    """Whose steps --csv and --minari take: a name, or the path of a description (.toml)."""
    json: bool = False

    def run(self) -> int:
        wanted = {"csv": self._csv, "minari": self._minari, "foxglove": self._foxglove, "tlog": self._tlog}
        asked = [name for name in wanted if getattr(self, name) is not None]
        if not asked:
            raise ValueError(f"export to what? Give {', '.join(f'--{name}' for name in wanted)}, or several of them")
        figures: dict[str, Any] = {}
        for name in asked:
            with under_way(f"writing {getattr(self, name)}"):
                figures[name] = wanted[name]()
        if self.json:
            say_json(figures)
        else:
            for about in figures.values():
                counts = ", ".join(f"{count} {what}" for what, count in about.items() if what != "path")
                console.print(f"{about['path']}: {counts}", markup=False)
        return 0

    def _csv(self) -> dict[str, Any]:
        from brakeline.logs.log_export import to_csv
        from brakeline.logs.minari_export import ExportError

        assert self.csv is not None
        robot = robot_with_task(self.robot)
        self.csv.parent.mkdir(parents=True, exist_ok=True)
        try:
            with self.csv.open("w", newline="") as file:
                return {"path": str(self.csv), "steps": to_csv(list(self.logs), robot, file)}
        except ExportError:
            if self.csv.is_file():  # with a headline alone; a pipe stays
                self.csv.unlink()
            raise

    def _minari(self) -> dict[str, Any]:
        from brakeline.logs.minari_export import to_minari

        assert self.minari is not None
        written = to_minari(list(self.logs), robot_with_task(self.robot), self.minari)
        return {"path": str(written.path), "episodes": written.episodes, "steps": written.steps}

    def _tlog(self) -> dict[str, Any]:
        from brakeline.logs.tlog_export import to_tlog

        assert self.tlog is not None
        with self.tlog.open("wb") as file:
            return {"path": str(self.tlog), "frames": to_tlog(list(self.logs), file)}

    def _foxglove(self) -> dict[str, Any]:
        from brakeline.logs.log_export import to_foxglove

        assert self.foxglove is not None
        return {"path": str(self.foxglove), "messages": to_foxglove(list(self.logs), self.foxglove)}
