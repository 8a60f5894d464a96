"""Time `train` with each backend until the policy reaches 90 % of its goals, in processor time and on the clock.

Both backends train from the same seeds, with all processes of a run and its log. The processor time is that of all
processes. Every 1,000 steps a run writes its policy. Afterwards, each policy drives without exploration in the same
fresh episodes; a bisection finds the first one with 90 %.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.timing import Figures, processor_times
from brakeline.messaging.policy_weights import MLP, POLICY
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.sim.batch.batch_env import BatchNavigationEnv

SHARE = 0.9  # of the goals
EPISODES, FRESH = 64, 987_654  # of an evaluation, and the key of their arenas
STEPS = {"processes": 14_000, "batch": 30_000}  # of a run
EVERY = 1000  # steps between two policies


@dataclass(frozen=True)
class Snapshot:
    """A policy of a run, and what the run had taken until then."""

    policy: Path
    processor: float  # s, of all processes
    clock: float  # s


def run(seeds: int, batch: Sequence[str]) -> Figures:
    """Return a row for each backend and seed, and the ratios of the backends. batch: more options for `batch`."""
    figures: Figures = {}
    robot = robot_with_task("ground")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(seeds):
            for backend in STEPS:  # in turn, so that a change of the machine's load meets both
                more = batch if backend == "batch" else ()
                snapshots = trained(Path(folder) / f"{backend}-{seed}", backend, seed, more)
                figures[f"{backend}, seed {seed}"] = reached(robot, snapshots)
    for what in ("processor s", "clock s"):
        slow, fast = (
            np.array([figures[f"{backend}, seed {seed}"][what] for seed in range(seeds)]) for backend in STEPS
        )
        ratios = fast / slow
        row = {"median": float(np.median(ratios)), "least": float(ratios.min()), "most": float(ratios.max())}
        figures[f"batch / processes, {what}"] = row
    return figures


def trained(out: Path, backend: str, seed: int, more: Sequence[str] = ()) -> list[Snapshot]:
    """Train with more options, and return the policies of the run."""
    command = [sys.executable, "-P", "-m", "brakeline.deploy.cli", "train", "ground", "--backend", backend, "--json"]
    command += ["--seed", str(seed), "--steps", str(STEPS[backend]), "--out", str(out)]
    command += ["--learner.checkpoint-every", str(EVERY), *more]
    snapshots: list[Snapshot] = []
    started, seen, policy = time.monotonic(), 0, out / "learner" / POLICY
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        spent: dict[str, float] = {}
        while process.poll() is None:
            time.sleep(0.2)
            spent |= processor_times(process.pid)
            if policy.exists() and (written := policy.stat().st_mtime_ns) != seen:
                seen, snapshot = written, out / f"{len(snapshots)}.safetensors"
                snapshot.write_bytes(policy.read_bytes())
                snapshots.append(Snapshot(snapshot, sum(spent.values()), time.monotonic() - started))
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} failed: see {out}/logs")
    return snapshots


def reached(robot: RobotWithTask, snapshots: list[Snapshot]) -> dict[str, float]:
    """Return the first policy that reaches `SHARE` of its goals, by a bisection; infinite times if none does."""
    low, high, share = 0, len(snapshots), 0.0
    while low < high:
        middle = (low + high) // 2
        now = goals(robot, MLP.load(snapshots[middle].policy, robot))
        low, high, share = (low, middle, now) if now >= SHARE else (middle + 1, high, share)
    if low == len(snapshots):
        return {"steps": np.inf, "processor s": np.inf, "clock s": np.inf, "goals %": 100.0 * share}
    first = snapshots[low]
    times = {"processor s": first.processor, "clock s": first.clock}
    return {"steps": (low + 1) * EVERY, "goals %": 100.0 * share} | times


def goals(robot: RobotWithTask, policy: MLP) -> float:
    """Return the share of fresh episodes in which a policy behind the filter reaches the goal."""
    episodes = BatchNavigationEnv(robot, EPISODES, seed_key=FRESH)
    env = BatchSafetyWrapper(episodes, Filter.load(robot.name), turn_aside=robot.task.turn_aside)
    observations, _ = env.reset(options={"episode_seeds": np.arange(EPISODES)})
    done, reached = np.zeros((2, EPISODES), dtype=bool)
    for _ in range(robot.task.arenas["default"].step_limit):
        observations, _, terminated, truncated, infos = env.step(policy.of_many(observations))
        ended = (terminated | truncated) & ~done
        if ended.any():
            reached |= ended & infos["final_info"]["at_goal"]
            done |= ended
        if done.all():
            break
    env.close()
    return float(reached.mean())
