"""Add up the lines that `run.py` wrote, as the table of docs/other_environments.md. python table.py *.jsonl"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).parents[2]))

from examples.foreign.table import groups_of, row

HEAD = (
    *("pushed", "policy", "filter", "episodes", "with a violation", "steps in violation", "fell", "corrected steps"),
    *("error [m]", "return", "outside the prediction", "decision, processor time [ms]", "decisions"),
)


def main(*paths: str) -> None:
    print(row(HEAD), row(["---"] * len(HEAD)), sep="\n")
    groups = groups_of(paths, ("disturbed", "policy", "amplitude", "filter"))
    for (disturbed, policy, amplitude, name), episodes in groups:
        wanted = policy if amplitude == 1.0 else f"{policy}, {amplitude:g} m"
        print(row(["yes" if disturbed else "no", wanted, name, *cells(episodes, name)]))


def cells(episodes: list[dict[str, Any]], name: str) -> list[object]:
    """Return the cells of episodes of different seeds behind a filter, from their number on."""
    count, steps = len(episodes), sum(e["steps"] for e in episodes)
    violated, corrected = sum(e["violations"] > 0 for e in episodes), sum(e["corrected"] for e in episodes)
    interval = binomtest(violated, count).proportion_ci(0.99, method="exact")
    kinds = sum((Counter(e["kinds"]) for e in episodes), Counter[str]())
    return [
        count,
        f"{violated} ({100 * interval.low:.1f} to {100 * interval.high:.1f} %)",
        f"{sum(e['violations'] for e in episodes)} of {steps}",
        sum(e["fell"] for e in episodes),
        "–" if name == "none" else f"{corrected / steps:.1%}",
        f"{np.mean([e['error'] for e in episodes]):.2f}",
        f"{np.mean([e['return'] for e in episodes]):.0f}",
        f"{sum(e['outside'] for e in episodes)} of {steps}" if name == "brakeline" else "–",
        "–" if name == "none" else f"{np.median([e['cpu_ms'] for e in episodes]):.1f}",
        ", ".join(f"{number} {kind}" for kind, number in kinds.most_common()) or "–",
    ]


if __name__ == "__main__":
    main(*sys.argv[1:])
