"""`make bench`: every benchmark, each beside its peer in the same run.

python -m deploy.bench [NAME ...] [--json]
python -m deploy.bench chaos --kills 30 --seed 1
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import sys

from rich.console import Console
from rich.table import Table

from deploy.bench import (
    askers,
    chaos,
    costs,
    decide,
    environment,
    fuzz,
    learning,
    linkloss,
    logs,
    perception,
    reachability,
    recording,
    roundtrip,
    solvers,
)
from deploy.bench.timing import Figures

BENCHMARKS = {
    "decide": decide.run,
    "perception": perception.run,
    "solvers": solvers.run,
    "reachability": reachability.run,
    "environment": environment.run,
    "learning": learning.run,
    "roundtrip": roundtrip.run,
    "linkloss": linkloss.run,
    "logs": logs.run,
    "recording": recording.run,
    "logs-2gb": logs.run_large,
    "fuzz": fuzz.run,
    "askers": askers.run,
    "costs": costs.run,
    "chaos": chaos.run,
}
# One writes as much, others take a quarter of an hour or more, or need root.
WHEN_ASKED = {"logs-2gb", "fuzz", "chaos", "costs"}


def show(console: Console, name: str, figures: Figures) -> None:
    table = Table(title=name)
    table.add_column("what")
    columns = sorted({key for row in figures.values() for key in row}, key=str)
    for column in columns:
        table.add_column(column, justify="right")
    for what, row in figures.items():
        table.add_row(what, *(f"{row[c]:.4g}" if c in row else "" for c in columns))
    console.print(table)


def main() -> int:
    names = [word for word in sys.argv[1:] if not word.startswith("-") and not word.isdecimal()]
    names = names or [name for name in BENCHMARKS if name not in WHEN_ASKED]
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        print(f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    results = {}
    for name in names:
        results[name] = BENCHMARKS[name]()
        if "--json" not in sys.argv:
            show(Console(), name, results[name])
    if "--json" in sys.argv:
        print(json.dumps(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
