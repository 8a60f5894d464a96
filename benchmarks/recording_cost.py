"""What a log costs: training with a recorder and without one, in pairs, each first in turn.

On a machine that others use too, the rates say more of them; the recorder's share of the run's processor time does not.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from benchmarks.timing import Figures
from brakeline.deploy.interpreter import PYTHON

STEPS = 4000
PAIRS = 3
LOOK = 0.5  # s between two looks at the processes


def training(out: Path, record: bool) -> tuple[float, float]:
    """Steps a second of a run, from its first step to its last, and the recorder's share of its processor time then."""
    words = [
        *PYTHON,
        "-m",
        "brakeline.deploy.cli",
        "train",
        "ground",
        "--steps",
        str(STEPS),
        "--json",
        "--out",
        str(out),
    ]
    run = subprocess.Popen(
        [*words, "--record" if record else "--no-record"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    looks = []
    while run.poll() is None:
        looks.append(processor_time(run.pid, out))
        time.sleep(LOOK)
    assert run.stdout is not None
    figures = json.loads(run.stdout.read())
    if figures["steps"] < STEPS:
        raise RuntimeError(f"the run of {out} took {figures['steps']} of {STEPS} steps")
    return figures["steps"] / figures["driven_s"], _share(looks)


def processor_time(launcher: int, out: Path) -> dict[str, float]:
    """Seconds of each living process of a run, by name."""
    found = {}
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        child = "brakeline.deploy.run.run_process" in words and str(out) in words
        if child or process.pid == launcher:
            try:
                times = process.cpu_times()
            except psutil.Error:  # it has just ended
                continue
            found[words[-1] if child else "launcher"] = times.user + times.system
    return found


def _share(looks: list[dict[str, float]]) -> float:
    """Of the recorder, between two looks at which all processes lived and had started: a third of the way, and last."""
    most = max(map(len, looks))
    whole = [look for look in looks if len(look) == most]
    first, last = whole[len(whole) // 3], whole[-1]
    spent = {name: last[name] - first.get(name, 0.0) for name in last}
    return spent.get("recorder", 0.0) / max(sum(spent.values()), 1e-9)


def run() -> Figures:
    pairs, shares = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(PAIRS):
            found = {}
            for record in (True, False) if number % 2 else (False, True):
                found[record], share = training(Path(folder) / f"{number}-{record}", record)
                shares += [share] if record else []
            pairs.append((found[True], found[False]))
    recorded, bare = np.array(pairs).T
    cost = 100.0 * (1.0 - recorded / bare)
    return {
        "with a recorder": {
            "steps/s": float(recorded.mean()),
            "% of the run's processor time": 100 * float(np.mean(shares)),
        },
        "without": {"steps/s": float(bare.mean())},
        "cost of recording": {
            "%, mean": float(cost.mean()),
            "%, least": float(cost.min()),
            "%, most": float(cost.max()),
        },
    }
