"""Draw how the speed of a batch grows with its robots, from the figures of `batch-simulation`.

python -m benchmarks batch-simulation --json > figures.json
python -m benchmarks.growth_plot figures.json docs/figures/batch_simulation.svg
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from matplotlib import pyplot

ROW = re.compile(r"ground, filtered, (\d+) robots: beside one")


def draw(figures: Path, out: Path) -> None:
    """Draw the filtered steps for each second of processor time against the number of robots, beside one robot."""
    rows = json.loads(figures.read_text())["batch-simulation"]
    points = sorted((int(found[1]), row) for name, row in rows.items() if (found := ROW.fullmatch(name)))
    sizes = [size for size, _ in points]
    figure, axes = pyplot.subplots(figsize=(6.0, 3.2), layout="constrained")
    for name, label, style in (
        ("batch steps/s", "BatchSafetyWrapper(BatchNavigationEnv)", "o-"),
        ("peer steps/s", "SafetyWrapper(NavigationEnv), one robot", "s--"),
    ):
        axes.plot(sizes, [row[name] for _, row in points], style, label=label)
    axes.set_xscale("log", base=2)
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("robots in the batch")
    axes.set_ylabel("filtered steps for each\nsecond of processor time")
    axes.grid(alpha=0.3)
    axes.legend()
    pyplot.rcParams["svg.hashsalt"] = out.name  # the same figures give the same file
    figure.savefig(out, metadata={"Date": None})


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
