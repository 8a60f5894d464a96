"""Measure what minutes of ordinary driving give for four robots: the table in docs/own_log.md.

python examples/own_log/table.py                               # all of it: about a quarter of an hour
python examples/own_log/table.py --robots diff --minutes 4 --quick

Each row is a log of its own, the four commands of docs/data.md on it, and the filter with the model set that they give.
The simulators judge: a collision is one of the true body, at every step of the integration.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from arena import AT_GOAL, Adversary, Arena, Planner
from drive import VEHICLES, Simulator, Vehicle
from numpy.typing import NDArray

from brakeline import BackupPlan, Dataset, Filter, InProcess, ModelSet, Obstacle, Request, Shapes, validate
from brakeline.messaging.stated_share import percent
from brakeline.safety.model.calibration_samples import samples_of
from brakeline.safety.model.driving_kinds import driving_kinds
from brakeline.safety.model.model_set import extra_coordinates

Array = NDArray[np.float64]

HERE = Path(__file__).parent
SAMPLED = 20_000  # plans for the truth's box
FRESH, FRESH_QUICK = 60, 6  # runs of a minute
EPISODE, TO_GOAL = 6.0, 60.0  # s
ROOM = 0.1  # m beyond the body that the planner keeps to obstacles; it knows nothing of the filter


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def record(robot: str, minutes: float, seed: int, path: Path, runs: int = 1) -> Path:
    """Write the log of a drive."""
    words = [sys.executable, str(HERE / "drive.py"), robot, "--minutes", str(minutes), "--seed", str(seed)]
    with path.open("w") as file:
        subprocess.run([*words, "--runs", str(runs)], stdout=file, check=True)
    return path


def brakeline(folder: Path, *words: str) -> str:
    """Run a command with its data in a folder, and return what it prints."""
    call = [sys.executable, "-m", "brakeline.deploy.cli", *words]
    known = os.environ | {"BRAKELINE_DATA": str(folder / "data")}
    done = subprocess.run(call, env=known, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"brakeline {' '.join(words)}: {done.stderr}")
    return done.stdout


def certified(folder: Path, robot: str, log: Path, mode: str) -> tuple[ModelSet, dict[str, Any]]:
    """Run the four commands on a log, and return the model set in use with its validation report."""
    description = str(HERE / f"{robot}.toml")
    brakeline(folder, "robot", "new", str(folder / "draft.toml"), "--from", str(log))  # to be filled in by hand
    brakeline(folder, "robot", "check", description)
    brakeline(folder, "import", str(log), "--robot", description)
    how = [] if mode == "one-step" else ["--mode", mode, "--certificates", "residual"]
    output = brakeline(folder, "certify", description, "--use", "--accept-bound", "1", "--json", *how)
    (path,) = (folder / "data").glob(f"*/residual-{mode}.safetensors")
    (report,) = (value for value in json.loads(output).values() if isinstance(value, dict) and "windows" in value)
    return ModelSet.load(path), report


def half_widths(vehicle: Vehicle, safety: Filter, turn: float) -> dict[str, float]:
    """Compare the set at a plan's end, from full speed, with the box of the sampled truth [m].

    Args:
        vehicle: the robot.
        safety: its filter.
        turn: the second input, as a share of its bound.
    """
    draw, held = np.random.default_rng(0), np.array([vehicle.high[0], turn * vehicle.high[1]])
    one = Simulator(vehicle, draw, np.zeros((1, 3)))
    one.advance(held[None], 2.0 * vehicle.rest)
    one.state[:3] = 0.0
    backup_plan = BackupPlan(safety.robot)
    request = Request(one.state[:, 0], held, held, backup_plan.plan, Shapes.of([], 2), known_free=True)
    decision = safety.decide(request)
    many = one.spread(SAMPLED)
    for inputs in decision.plan:
        many.advance(np.tile(inputs, (SAMPLED, 1)), vehicle.period)
    measured = many.measure()[:, :2]
    half = decision.tube_half_width[-1] - np.array(vehicle.errors[:2])  # of measured positions
    box = (measured.max(0) - measured.min(0)) / 2.0
    return {"set": float(half.max()), "truth": float(box.max())}


def fresh_shares(model: ModelSet, fitted: Dataset, data: Dataset) -> dict[str, Any]:
    """Return the share of plans of new driving outside their sets, overall and by kind of driving."""
    robot = model.robot
    if model.one_step is None:
        report = validate(model, fitted, data)
        return {"plans": report.windows, "outside": report.violations / report.windows, "kinds": {}}
    s = samples_of(data)
    errors = np.abs(s.after - model.one_step.rollouts(robot, s.z))
    stretch = model.one_step.stretches(robot, s.z)  # sets grow off the recorded driving
    widths = np.stack([step.half_widths(s.z) for step in model.steps], axis=1) * stretch[..., None]
    used = [*range(robot.position_dim), *extra_coordinates(robot)]
    outside = (errors > widths)[..., used].any((1, 2)) | (errors > widths)[:, 0].any(1)
    off_chord = (s.chords > model.chord_deviations.half_widths(s.z)).any(1)
    kinds = driving_kinds(robot, s.z, s.start)
    return {
        "plans": len(outside),
        "outside": float((outside | off_chord).mean()),
        "kinds": {
            name: {"plans": int(kind.sum()), "outside": float((outside | off_chord)[kind].mean())}
            for name, kind in kinds.items()
            if kind.any()
        },
    }


def episodes(vehicle: Vehicle, safety: Filter, count: int, driver: str, seed: int) -> dict[str, Any]:
    """Drive episodes behind the filter. driver: adversary, or planner."""
    client = InProcess(safety, accept_bound=1.0)  # one for all episodes: its widening goes on
    footprint = safety.robot.footprint
    room = footprint + ROOM
    nearest, goals, times, widenings, kinds = [], 0, [], [], Counter[str]()
    scored, left = 0, 0
    limit = round((EPISODE if driver == "adversary" else TO_GOAL) / vehicle.period)
    for episode in range(count):
        draw = np.random.default_rng(seed + episode)
        arena = Arena.random(draw, room)
        near = [Obstacle("cylinder", tuple(c), (r,)) for c, r in zip(arena.centers, arena.radii, strict=True)]
        simulator = Simulator(vehicle, draw, arena.start[None])
        client.reset()
        adversary, planner = Adversary(vehicle, arena, episode % 2 == 1), Planner(arena, room)
        closest = np.inf
        for _ in range(limit):
            state = simulator.measure()[0]
            wanted = adversary.inputs(state) if driver == "adversary" else planner.inputs(vehicle, state)
            answer = client.decide(state, wanted, near, known_free=True)
            kinds[answer.kind] += 1
            times.append(answer.time_ms)
            widenings.append(client.backup_plan.widening.factor)
            if answer.score is not None:
                scored, left = scored + 1, left + (answer.score > 1.0)
            poses = simulator.advance(answer.action[None], vehicle.period)[:, :, 0]
            closest = min(closest, arena.clearance(vehicle, poses))
            if driver == "planner" and np.linalg.norm(simulator.state[:2, 0] - arena.goal) < AT_GOAL:
                goals += 1
                break
        nearest.append(closest)
        if (episode + 1) % 50 == 0:
            say(f"  {driver}: {episode + 1} episodes, nearest {min(nearest):.3f} m, {goals} goals")
    steps = sum(kinds.values())
    return {
        "episodes": count,
        "steps": steps,
        "collisions": int((np.array(nearest) < 0.0).sum()),
        "nearest": float(min(nearest)),
        "nearest_median": float(np.median(nearest)),
        "goals": goals,
        "decisions": {kind: n / steps for kind, n in kinds.items()},
        "windows_outside": left / max(scored, 1),
        "widening_median": float(np.median(widenings)),
        "widening_largest": float(max(widenings)),
        "time_ms_p50": float(np.median(times)),
    }


def measure(robot: str, minutes: float, words: argparse.Namespace) -> dict[str, Any]:
    """Measure one row of the table."""
    vehicle, began = VEHICLES[robot], time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = record(robot, minutes, words.seed, folder / "drive.csv")
        started = time.monotonic()
        model, report = certified(folder, robot, log, words.mode)
        commands_s = time.monotonic() - started
        say(f"{robot}, {minutes:g} minutes: certified after {commands_s:.0f} s")
        fitted = Dataset.load(next((folder / "data").glob("*/record.safetensors")))
        runs = FRESH_QUICK if words.quick else FRESH
        hour = record(robot, runs, words.seed + 1000, folder / "hour.csv", runs)
        fresh = folder / "fresh.safetensors"
        brakeline(folder, "import", str(hour), "--robot", str(HERE / f"{robot}.toml"), "--out", str(fresh))
        shares = fresh_shares(model, fitted, Dataset.load(fresh))
    safety, count = Filter(model), 20 if words.quick else words.episodes
    say(f"  clearance {safety.clearance_margin:.3f} m, {shares['outside']:.2%} of fresh plans outside")
    adversary = episodes(vehicle, safety, count, "adversary", 10_000 + words.seed)
    planner = episodes(vehicle, safety, count // 2, "planner", 20_000 + words.seed)
    return {
        "robot": robot,
        "minutes": minutes,
        "mode": words.mode,
        "commands_s": commands_s,
        "straight": half_widths(vehicle, safety, 0.0),
        "turning": half_widths(vehicle, safety, 1.0),
        "clearance": safety.clearance_margin,
        "bound": report["bound_plan"],
        "marginal": report.get("marginal"),
        "kinds": {group["name"]: group for group in report.get("groups", [])},
        "chosen": report.get("chosen"),
        "fresh": shares,
        "adversary": adversary,
        "planner": planner,
        "seconds": time.monotonic() - began,
    }


HEADER = (
    "robot",
    "log",
    "after a stop, straight (truth)",
    "turning (truth)",
    "clearance",
    "stated",
    "fresh plans outside",
    "worst kind (stated)",
    "adversary: nearest (episodes)",
    "collisions",
    "goals",
)


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    for row in rows:
        cells = [row["robot"], f"{row['minutes']:g} min"]
        cells += [f"{1e3 * row[k]['set']:.0f} ({1e3 * row[k]['truth']:.0f}) mm" for k in ("straight", "turning")]
        cells += [f"{1e3 * row['clearance']:.0f} mm", f"≤ {percent(row['bound'])}"]
        cells += [f"{100.0 * row['fresh']['outside']:.2f} %"]
        kinds = row["fresh"]["kinds"]
        worst = max(kinds, key=lambda name: kinds[name]["outside"], default="")
        stated = row["kinds"].get(worst, {}).get("bound")
        statement = "–" if stated is None else f"{worst}: {100.0 * kinds[worst]['outside']:.2f} % (≤ {percent(stated)})"
        run = row["adversary"], row["planner"]
        cells += [statement, f"{1e2 * run[0]['nearest']:.1f} cm ({run[0]['episodes']})"]
        cells += [f"{run[0]['collisions']} and {run[1]['collisions']}", f"{run[1]['goals']} of {run[1]['episodes']}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--robots", nargs="+", choices=VEHICLES, default=list(VEHICLES))
    parser.add_argument("--minutes", nargs="+", type=float, default=[4.0, 15.0], help="Lengths of the logs.")
    parser.add_argument("--seed", type=int, default=1, help="Seed of the logs and episodes.")
    parser.add_argument("--mode", choices=("one-step", "direct"), default="one-step", help="Form of the model set.")
    parser.add_argument(
        "--episodes", type=int, default=200, help="Adversary's episodes; the planner drives half as many."
    )
    parser.add_argument("--quick", action="store_true", help="Drive 20 episodes, and six minutes of new driving.")
    parser.add_argument("--json", type=Path, help="Write all figures to this file, too.")
    words = parser.parse_args()
    rows = []
    for robot in words.robots:
        for minutes in words.minutes:
            rows.append(measure(robot, minutes, words))
            if words.json:
                words.json.write_text(json.dumps(rows, indent=1))
    print(markdown(rows))


if __name__ == "__main__":
    main()
