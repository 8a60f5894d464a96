"""Implement `brakeline analyse`: compute the figures of logs, and write a report."""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brakeline.deploy.commands.command_output import console, errors, print_json
from brakeline.deploy.commands.common_options import LATEST, Json, Logs, Quiet, Verbose
from brakeline.deploy.progress import under_way


@dataclass(frozen=True)
class AnalyseCommand:
    """The options of `brakeline analyse`."""

    logs: Logs = (LATEST,)
    html: Path | None = None
    """Write a report to this file: one page that needs no network."""
    figure: Path | None = None
    """Draw the learning curves into this file (.png, .pdf or .svg). Runs that differ only in their seed become one
    curve: their mean with its 95 % interval."""
    episode: int | None = None
    """Show each step of the episode with this number, of each actor."""
    actor: str | None = None
    """With --episode, show the episode of this actor only. With several runs, actor-0 means that of each run, and
    RUN/actor-0 that of one."""
    verbose: Verbose = False
    quiet: Quiet = False
    json: Json = False
    csv: bool = False
    """Print a CSV table with one row for each run, or with --episode for each step."""

    def run(self) -> int:
        """Print the figures. Returns the exit status."""
        from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs
        from brakeline.logs.reader import refuse_to_overwrite_log

        if self.json and self.csv:
            raise ValueError("--json and --csv exclude each other: give one of them")
        if self.actor is not None and self.episode is None:
            raise ValueError("--actor selects an episode's actor: give --episode too")
        if self.html is not None:
            refuse_to_overwrite_log(self.html)
        with under_way("reading " + ", ".join(map(str, self.logs))):
            analysis = analyse_runs(list(self.logs), AnalysisOptions(self.html is not None, self.episode, self.actor))
        figures = analysis.figures()
        if self.episode is not None and not figures["episode_detail"]:
            actor = f" of {self.actor}" if self.actor else ""
            raise ValueError(f"there is no episode {self.episode}{actor} in {', '.join(figures['log'])}")
        if self.html is not None:
            from brakeline.logs.report_page import write

            write(self.html, figures, analysis.by_label())
            errors.print(f"report: {self.html}", markup=False)
        if self.figure is not None:
            from brakeline.logs.run_plots import draw  # imports Matplotlib, which takes a second

            draw(figures, self.figure)
            errors.print(f"learning curves: {self.figure}", markup=False)
        self._print(figures)
        return 0

    def _print(self, figures: dict[str, Any]) -> None:
        from brakeline.logs.figure_tables import show, show_episode

        episodes = figures.get("episode_detail", [])
        if self.json:
            print_json(figures)
        elif self.csv and episodes:
            print_csv([row for episode in episodes for row in episode["rows"]])
        elif self.csv:
            print_csv([{"run": label, **run} for label, run in figures["runs"].items()])
        elif episodes:
            for episode in episodes:
                console.print(show_episode(episode))
        else:
            console.print(show(figures, self.verbose))


def print_csv(rows: list[dict[str, Any]]) -> None:
    """Print a table on stdout. The names of nested values are joined by dots; values of lists are numbered."""
    flat = [dict(_flat(row)) for row in rows]
    columns = list(dict.fromkeys(name for row in flat for name in row))
    table = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(flat)


def _flat(row: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the name and value of each column, without the metadata."""
    columns: list[tuple[str, Any]] = []
    for name, value in row.items():
        nested = {str(i): item for i, item in enumerate(value)} if isinstance(value, list) else value
        if not isinstance(nested, dict):
            columns.append((f"{prefix}{name}", value))
        elif name != "metadata":
            columns += _flat(nested, f"{prefix}{name}.")
    return columns
