"""Run benchmarks, each beside its peer in the same run (`make bench`)."""

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
    adaptation_in_flight,
    askers,
    autopilot_conformance,
    barrier_peers,
    batch_decide,
    batch_device,
    batch_simulation,
    changed_robots,
    costs,
    decide,
    driving_groups,
    environment_speed,
    flights,
    growth,
    learning_speed,
    log_reading,
    model_peers,
    perception_cost,
    roundtrip,
    service_limit,
    set_widths,
    solvers,
    step_cost,
    training_speed,
    widening_share,
)
from benchmarks.timing import Figures, Words
from brakeline.logs.stacking_table import StackingTable
from tests.faults import autopilot_disturbances, campaign, crowd, link_faults, link_loss
from tests.fuzz import message_fuzz


@dataclass(frozen=True)
class Bench:
    """Run the named benchmarks, or every one that needs neither root nor a quarter of an hour."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Run these benchmarks. By default, all run except those that you have to name."""
    json: bool = False
    """Print one JSON object on stdout."""
    seed: int = 0
    """Draw the faults of fault-campaign and cuts, and the messages of fuzz, from this seed."""
    kills: int = 100
    """Cause this many faults in fault-campaign."""
    faults: int = 60
    """Cause this many faults in cuts."""
    messages: int = 1_000_000
    """Send this many messages in fuzz."""
    plans: int = driving_groups.PLANS
    """Drive this many plans of each group in groups."""
    seeds: int = 3
    """Train this many runs of each backend in training."""
    batch: str = ""
    """Give these options to the runs with --backend batch in training: other settings of the learner."""
    rate: int = crowd.JUNK
    """Let each sender of crowd send this many junk messages a second."""
    minutes: float = 10.0
    """Fly each policy of flights for this long in each arena [min]."""
    device: str = "cuda"
    """Decide on this device of torch in batch-device."""
    against: Path | None = None
    """Run step with the code of this checkout, too, at the same time."""
    folder: Path = Path("runs/flights")
    """Store the data, logs and figures of flights, upsets, cuts and fault-campaign here. What the folder has is not
    repeated."""


@dataclass(frozen=True)
class Benchmark:
    """A benchmark: its module, whose documentation says what it measures, and how it runs.

    Attributes:
        named: it runs only when you name it, since it writes gigabytes, takes minutes, or needs root or other programs.
    """

    module: ModuleType
    run: Callable[[Bench], Figures | Words]
    named: bool = False


BENCHMARKS = {
    "decide": Benchmark(decide, lambda _: decide.run()),
    "batch": Benchmark(batch_decide, lambda _: batch_decide.run()),
    "batch-device": Benchmark(batch_device, lambda given: batch_device.run(given.device), named=True),
    "batch-simulation": Benchmark(batch_simulation, lambda _: batch_simulation.run()),
    "perception": Benchmark(perception_cost, lambda _: perception_cost.run()),
    "solvers": Benchmark(solvers, lambda _: solvers.run()),
    "environment": Benchmark(environment_speed, lambda _: environment_speed.run()),
    "learning": Benchmark(learning_speed, lambda _: learning_speed.run()),
    "roundtrip": Benchmark(roundtrip, lambda _: roundtrip.run()),
    "linkloss": Benchmark(link_loss, lambda _: link_loss.run()),
    "logs": Benchmark(log_reading, lambda _: log_reading.run()),
    "askers": Benchmark(askers, lambda _: askers.run()),
    "logs-2gb": Benchmark(log_reading, lambda _: log_reading.run_large(), named=True),
    "fuzz": Benchmark(message_fuzz, lambda given: message_fuzz.fuzz(given.messages, given.seed), named=True),
    "manners": Benchmark(autopilot_conformance, lambda _: autopilot_conformance.run(), named=True),
    "flights": Benchmark(flights, lambda given: flights.run(given.minutes, given.folder), named=True),
    "upsets": Benchmark(autopilot_disturbances, lambda given: autopilot_disturbances.run(given.folder), named=True),
    "cuts": Benchmark(link_faults, lambda given: link_faults.run(given.faults, given.seed, given.folder), named=True),
    "crowd": Benchmark(crowd, lambda given: crowd.run(given.rate), named=True),
    "model-peers": Benchmark(model_peers, lambda _: model_peers.run(), named=True),
    "barrier-peers": Benchmark(barrier_peers, lambda _: barrier_peers.run(), named=True),
    "training": Benchmark(
        training_speed, lambda given: training_speed.run(given.seeds, given.batch.split()), named=True
    ),
    "groups": Benchmark(driving_groups, lambda given: driving_groups.run(given.plans), named=True),
    "widths": Benchmark(set_widths, lambda _: set_widths.run(), named=True),
    "adaptation": Benchmark(adaptation_in_flight, lambda _: adaptation_in_flight.run(), named=True),
    "changed": Benchmark(changed_robots, lambda _: changed_robots.run(), named=True),
    "widening": Benchmark(widening_share, lambda _: widening_share.run(), named=True),
    "costs": Benchmark(costs, lambda _: costs.run(), named=True),
    "limit": Benchmark(service_limit, lambda _: service_limit.run()),
    "growth": Benchmark(growth, lambda _: growth.run(), named=True),
    "step": Benchmark(step_cost, lambda given: step_cost.run(given.against), named=True),
    "fault-campaign": Benchmark(
        campaign, lambda given: campaign.campaign(given.kills, given.seed, given.folder), named=True
    ),
}


def overview() -> str:
    """Return what each benchmark measures, and examples."""
    lines = []
    for name, one in BENCHMARKS.items():
        what = (one.module.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
        lines.append(f"  {name}: {what}{' Runs only if you name it.' if one.named else ''}")
    examples = "  python -m benchmarks decide --json\n  python -m benchmarks fault-campaign --kills 30 --seed 1"
    return "\n".join([Bench.__doc__ or "", "", *lines, "", "examples:", examples])


def print_figures(console: Console, name: str, figures: Figures | Words) -> None:
    """Print the figures of a benchmark as a table."""
    columns = sorted({key for row in figures.values() for key in row}, key=str)
    table = StackingTable("what", title=name)
    for column in columns:
        table.add_column(column, justify="right")
    for what, row in figures.items():
        values = (row.get(column, "") for column in columns)
        table.add_row(what, *(value if isinstance(value, str) else f"{value:.4g}" for value in values))
    console.print(table)


def main() -> int:
    """Run the benchmarks that the command line names. Returns the exit status."""
    given = tyro.cli(Bench, prog="python -m benchmarks", description=overview())
    names = given.names or tuple(name for name, one in BENCHMARKS.items() if not one.named)
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        print(f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that all that was started ends too
    results = {}
    for name in names:
        results[name] = BENCHMARKS[name].run(given)
        if not given.json:
            print_figures(Console(), name, results[name])
    if given.json:
        print(json.dumps(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
