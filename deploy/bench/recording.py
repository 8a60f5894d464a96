"""What a log costs: training with a recorder and without one, in pairs, each first in turn."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from deploy.bench.timing import Figures

STEPS = 4000
PAIRS = 3


def training(out: Path, record: bool) -> float:
    """Steps a second of a run, from its first step to its last."""
    words = [sys.executable, "-m", "deploy.cli", "train", "ground", "--steps", str(STEPS), "--json", "--out", str(out)]
    done = subprocess.run([*words, "--record" if record else "--no-record"], check=True, capture_output=True, text=True)
    figures = json.loads(done.stdout)
    if figures["steps"] < STEPS:
        raise RuntimeError(f"the run of {out} took {figures['steps']} of {STEPS} steps")
    return float(figures["steps"] / figures["driven_s"])


def run() -> Figures:
    pairs = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(PAIRS):
            order = (True, False) if number % 2 else (False, True)
            rates = {record: training(Path(folder) / f"{number}-{record}", record) for record in order}
            pairs.append((rates[True], rates[False]))
    recorded, bare = np.array(pairs).T
    cost = 100.0 * (1.0 - recorded / bare)
    return {
        "with a recorder": {"steps/s": float(recorded.mean())},
        "without": {"steps/s": float(bare.mean())},
        "cost of recording": {
            "%, mean": float(cost.mean()),
            "%, least": float(cost.min()),
            "%, most": float(cost.max()),
        },
    }
