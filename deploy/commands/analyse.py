"""`brakeline analyse` and `brakeline recover`."""

from __future__ import annotations

import csv
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from brakeline.deploy.commands.common_options import console, errors, say_json
from brakeline.deploy.progress import under_way
from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs
from brakeline.logs.log_recovery import recover
from brakeline.logs.reader import find
from brakeline.logs.report import show, show_episode


@dataclass(frozen=True)
class Analyse:
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (Path("runs/latest"),)
    """Log files, or run folders; also those of killed recorders."""
    html: Path | None = None
    """Write a report into this file: one page that needs no network."""
    png: Path | None = None
    """Draw the learning curves into this file."""
    episode: int | None = None
    """Show the episode of this number step by step, of every actor."""
    actor: str | None = None
    """With --episode: of this actor only."""
    verbose: bool = False
    """Say also how the run was made: sensors' errors, model sets, versions."""
    json: bool = False
    csv: bool = False
    """Print a table with a row for each run (with --episode: for each step)."""

    def run(self) -> int:
        if self.json and self.csv:
            raise ValueError("--json or --csv: one of them")
        with under_way("reading " + ", ".join(map(str, self.logs))):
            analysis = analyse_runs(list(self.logs), AnalysisOptions(self.html is not None, self.episode, self.actor))
        figures = analysis.figures()
        if self.episode is not None and not figures["episode_detail"]:
            whose = f" of {self.actor}" if self.actor else ""
            raise ValueError(f"there is no episode {self.episode}{whose} in {', '.join(figures['log'])}")
        if self.html is not None:
            from brakeline.logs.report_page import write

            write(self.html, figures, analysis.each())
            errors.print(f"report: {self.html}", markup=False)
        if self.png is not None:
            from brakeline.logs.run_plots import draw  # Matplotlib: a second that nobody else shall wait

            draw(figures["training"], self.png)
            errors.print(f"learning curves: {self.png}", markup=False)
        self._say(figures)
        return 0

    def _say(self, figures: dict[str, Any]) -> None:
        detail = figures.get("episode_detail", [])
        if self.json:
            say_json(figures)
        elif self.csv and detail:
            say_csv([row for episode in detail for row in episode["rows"]])
        elif self.csv:
            say_csv([{"run": label, **run} for label, run in figures["runs"].items()])
        elif detail:
            for episode in detail:
                console.print(show_episode(episode))
        else:
            console.print(show(figures, self.verbose))


@dataclass(frozen=True)
class Recover:
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Log files, or run folders. Damaged files are replaced by whole ones, and kept as *.mcap.damaged."""
    out: Path | None = None
    """Leave the log (one file) as it is, and write what can be read of it here."""
    json: bool = False

    def run(self) -> int:
        paths = find(list(self.logs))
        if self.out is not None and len(paths) > 1:
            raise ValueError(f"--out takes what is in one file, and there are {len(paths)}")
        found = []
        for path in paths:
            with under_way(f"reading {path}"):
                found.append(recover(path, self.out))
            if not self.json:
                console.print(str(found[-1]), markup=False)
        if self.json:
            say_json({"files": [{name: _plain(value) for name, value in asdict(one).items()} for one in found]})
        return 0


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def say_csv(rows: list[dict[str, Any]]) -> None:
    """A table on stdout: nested values become columns with dotted names; lists of numbers, numbered ones."""
    flat = [dict(_flat(row)) for row in rows]
    columns = list(dict.fromkeys(name for row in flat for name in row))
    table = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(flat)


def _flat(row: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Name and value of each column; the metadata is left out."""
    columns: list[tuple[str, Any]] = []
    for name, value in row.items():
        nested = {str(place): item for place, item in enumerate(value)} if isinstance(value, list) else value
        if not isinstance(nested, dict):
            columns.append((f"{prefix}{name}", value))
        elif name != "metadata":
            columns += _flat(nested, f"{prefix}{name}.")
    return columns
