"""`make bench`: every benchmark, each beside its peer in the same run."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro
from rich.console import Console

from benchmarks import (
    askers,
    autopilot_conformance,
    costs,
    decide,
    environment_speed,
    flights,
    learning_speed,
    log_reading,
    perception_cost,
    reachability,
    recording_cost,
    roundtrip,
    solvers,
)
from benchmarks.timing import Figures, Words
from brakeline.logs.console_tables import StackingTable
from tests.faults import chaos, crowd, disturbances, link_faults, link_loss
from tests.fuzz import message_fuzz


@dataclass(frozen=True)
class Bench:
    """Every benchmark that needs neither root nor a quarter of an hour, or the named ones."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Which; all that do not have to be asked for, unless given."""
    json: bool = False
    """One JSON object on stdout."""
    seed: int = 0
    """Of chaos, cuts and fuzz."""
    kills: int = 100
    """Of chaos."""
    faults: int = 60
    """Of cuts."""
    delay: float = 0.0
    """Of chaos: s each way between actors and routers."""
    messages: int = 1_000_000
    """Of fuzz."""
    rate: int = crowd.JUNK
    """Of crowd: junk messages /s of each sender."""
    minutes: float = 10.0
    """Of flights: of each policy in each arena."""
    folder: Path = Path("runs/flights")
    """Of flights, upsets and cuts: where data, logs and figures are kept; what is there already is not flown again."""


@dataclass(frozen=True)
class Benchmark:
    module: ModuleType  # its documentation says what is measured
    run: Callable[[Bench], Figures | Words]
    asked: bool = False  # only when it is named: it writes gigabytes, takes minutes, or needs root or other programs


BENCHMARKS = {
    "decide": Benchmark(decide, lambda _: decide.run()),
    "perception": Benchmark(perception_cost, lambda _: perception_cost.run()),
    "solvers": Benchmark(solvers, lambda _: solvers.run()),
    "reachability": Benchmark(reachability, lambda _: reachability.run()),
    "environment": Benchmark(environment_speed, lambda _: environment_speed.run()),
    "learning": Benchmark(learning_speed, lambda _: learning_speed.run()),
    "roundtrip": Benchmark(roundtrip, lambda _: roundtrip.run()),
    "linkloss": Benchmark(link_loss, lambda _: link_loss.run()),
    "logs": Benchmark(log_reading, lambda _: log_reading.run()),
    "recording": Benchmark(recording_cost, lambda _: recording_cost.run()),
    "askers": Benchmark(askers, lambda _: askers.run()),
    "logs-2gb": Benchmark(log_reading, lambda _: log_reading.run_large(), asked=True),
    "fuzz": Benchmark(message_fuzz, lambda given: message_fuzz.fuzz(given.messages, given.seed), asked=True),
    "manners": Benchmark(autopilot_conformance, lambda _: autopilot_conformance.run(), asked=True),
    "flights": Benchmark(flights, lambda given: flights.run(given.minutes, given.folder), asked=True),
    "upsets": Benchmark(disturbances, lambda given: disturbances.run(given.folder), asked=True),
    "cuts": Benchmark(link_faults, lambda given: link_faults.run(given.faults, given.seed, given.folder), asked=True),
    "crowd": Benchmark(crowd, lambda given: crowd.run(given.rate), asked=True),
    "costs": Benchmark(costs, lambda _: costs.run(), asked=True),
    "chaos": Benchmark(chaos, lambda given: chaos.chaos(given.kills, given.seed, given.delay), asked=True),
}


def overview() -> str:
    """What each measures, and examples."""
    lines = []
    for name, one in BENCHMARKS.items():
        what = (one.module.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
        lines.append(f"  {name}: {what}{' (only when named)' if one.asked else ''}")
    examples = "  python -m benchmarks decide --json\n  python -m benchmarks chaos --kills 30 --seed 1"
    return "\n".join([Bench.__doc__ or "", "", *lines, "", "examples:", examples])


def _cell(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def show(console: Console, name: str, figures: Figures | Words) -> None:
    table = StackingTable(title=name)
    table.add_column("what")
    columns = sorted({key for row in figures.values() for key in row}, key=str)
    for column in columns:
        table.add_column(column, justify="right")
    for what, row in figures.items():
        table.add_row(what, *(_cell(row.get(c, "")) for c in columns))
    console.print(table)


def main() -> int:
    given = tyro.cli(Bench, prog="python -m benchmarks", description=overview())
    names = given.names or tuple(name for name, one in BENCHMARKS.items() if not one.asked)
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        print(f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # what it started ends with it
    results = {}
    for name in names:
        results[name] = BENCHMARKS[name].run(given)
        if not given.json:
            show(Console(), name, results[name])
    if given.json:
        print(json.dumps(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
