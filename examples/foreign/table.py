"""Add up the lines that `run.py` wrote, as the table of docs/other_environments.md. python table.py *.jsonl"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FIGURES = (
    *("episodes", "cost an episode", "highest cost of an episode", "reward an episode"),
    *("unverified steps", "steps outside", "decisions"),
)
HEAD = ("robot", "policy", "filter", *FIGURES)


def main(*paths: str) -> None:
    print(row(HEAD), row(["---"] * len(HEAD)), sep="\n")
    for (robot, policy, filtered), episodes in groups_of(paths, ("robot", "policy", "filter")):
        print(row([robot, policy, "yes" if filtered else "no", *figures(episodes)]))


def groups_of(paths: Sequence[str], keys: Sequence[str]) -> list[tuple[tuple[Any, ...], list[dict[str, Any]]]]:
    """Return the lines of files, one for each seed, in groups with the same values of `keys`, and these values."""
    groups: dict[tuple[Any, ...], dict[int, dict[str, Any]]] = {}
    for line in (json.loads(line) for path in paths for line in Path(path).read_text().splitlines()):
        groups.setdefault(tuple(line[key] for key in keys), {})[line["seed"]] = line
    return [(key, list(episodes.values())) for key, episodes in sorted(groups.items())]


def figures(episodes: list[dict[str, Any]]) -> list[object]:
    """Return the cells of `FIGURES` for episodes of different seeds."""
    steps, count = sum(e["steps"] for e in episodes), len(episodes)
    kinds = sum((Counter(e["decisions"]) for e in episodes), Counter[str]())
    unverified, outside = (sum(e[name] for e in episodes) for name in ("unverified", "outside"))
    return [
        count,
        f"{sum(e['cost'] for e in episodes) / count:.1f}",
        f"{max(e['cost'] for e in episodes):.0f}",
        f"{sum(e['reward'] for e in episodes) / count:.1f}",
        f"{unverified} of {steps}" if kinds else "–",
        f"{outside} of {steps} ({outside / steps:.1%})" if kinds else "–",
        ", ".join(f"{number} {kind}" for kind, number in kinds.most_common()) or "–",
    ]


def row(cells: Any) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


if __name__ == "__main__":
    main(*sys.argv[1:])
