"""From a log of your own robot, as CSV, to decisions about it: two commands and four lines.

python examples/own_robot_from_csv.py       # makes a small log of its own first
"""

import os
import tempfile
from pathlib import Path

import numpy as np
import small_log

from brakeline import BackupPlan, Filter, ModelSet, Obstacle, Request, Shapes
from brakeline.deploy.cli import main as brakeline


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["BRAKELINE_DATA"] = str(folder / "data")
        robot = folder / "my.toml"  # names, units, bounds, how it brakes
        robot.write_text(small_log.DESCRIPTION)
        log = small_log.write_csv(folder / "drive.csv")

        brakeline(["import", str(log), "--robot", str(robot)])
        certify = ["certify", "--robot", str(robot), "--certificates", "residual", "--mode", "direct", "--use"]
        brakeline([*certify, "--accept-bound", "0.05"])  # 12 minutes state more than the limit of 1 %: it is accepted

        filter = Filter(ModelSet.load(folder / "data" / "my-robot" / "residual-direct.safetensors"))
        decide(filter, 2.0)
        decide(filter, 0.4)


def decide(filter: Filter, distance: float) -> None:
    """Full speed ahead, at a pillar, from standing still."""
    kept = BackupPlan(filter.robot)  # the committed plan and the input in force: what an asker keeps between questions
    near = Shapes.of([Obstacle("cylinder", (distance, 0.0), (0.1,))], 2)
    answer = filter.decide(Request(np.zeros(5), np.array([0.4, 0.0]), kept.input_in_force, kept.plan, near))
    print(f"pillar at {distance} m: {answer.kind}, {answer.plan[0][0]:.2f} m/s")


if __name__ == "__main__":
    main()
