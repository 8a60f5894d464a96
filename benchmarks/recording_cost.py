"""Measure the cost of a log: training with and without a recorder, in pairs, each of them first in turn.

Other load on the machine changes the rates. It changes the recorder's share of the processor time less.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.timing import Figures, processor_times
from brakeline.deploy.interpreter import PYTHON

STEPS = 4000
PAIRS = 3
LOOK = 0.5  # s between two looks at the processes


def training(out: Path, record: bool) -> tuple[float, float]:
    """Train, and return the steps a second and the recorder's share of the processor time.

    Raises:
        RuntimeError: the run took too few steps.
    """
    words = ["train", "ground", "--steps", str(STEPS), "--json", "--out", str(out)]
    command = [*PYTHON, "-m", "brakeline.deploy.cli", *words, "--record" if record else "--no-record"]
    run, looks = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL), []
    while run.poll() is None:
        looks.append(processor_times(run.pid))
        time.sleep(LOOK)
    assert run.stdout is not None
    figures = json.loads(run.stdout.read())
    if figures["steps"] < STEPS:
        raise RuntimeError(f"the run of {out} took {figures['steps']} of {STEPS} steps")
    return figures["steps"] / figures["driven_s"], _share(looks)


def _share(looks: list[dict[str, float]]) -> float:
    """Return the recorder's share from a third of the looks at all processes to the last of these looks."""
    most = max(map(len, looks))
    whole = [look for look in looks if len(look) == most]
    first, last = whole[len(whole) // 3], whole[-1]
    spent = {name: last[name] - first.get(name, 0.0) for name in last}
    return spent.get("recorder", 0.0) / max(sum(spent.values()), 1e-9)


def run() -> Figures:
    """Return the rates with and without a recorder, and the cost of the recording."""
    pairs, shares = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(PAIRS):
            rates = {}
            for record in (True, False) if number % 2 else (False, True):
                rates[record], share = training(Path(folder) / f"{number}-{record}", record)
                shares += [share] if record else []
            pairs.append((rates[True], rates[False]))
    recorded, bare = np.array(pairs).T
    cost = 100.0 * (1.0 - recorded / bare)
    recorder = {"% of the run's processor time": 100 * float(np.mean(shares))}
    spread = {"%, mean": float(cost.mean()), "%, least": float(cost.min()), "%, most": float(cost.max())}
    return {
        "with a recorder": {"steps/s": float(recorded.mean())} | recorder,
        "without": {"steps/s": float(bare.mean())},
        "cost of recording": spread,
    }
