"""Get decisions about your own robot from a log of it, in CSV or as a ROS 2 bag: two commands and four lines.

python examples/own_robot_from_log.py           # writes a small log in CSV first
python examples/own_robot_from_log.py bag       # writes a small bag first; ROS is not needed
"""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import small_log

from brakeline import BackupPlan, Filter, ModelSet, Obstacle, Request, Shapes
from brakeline.deploy.cli import main as brakeline


def main(kind: str = "csv") -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["BRAKELINE_DATA"] = str(folder / "data")
        robot = folder / "my.toml"  # names, units, bounds, braking
        robot.write_text(small_log.DESCRIPTION)
        # The bag has /odom and /cmd_vel. The importer finds topics by their types; to name another one:
        # --map v=/wheels/twist.linear.x
        log = small_log.write_bag(folder / "bag") if kind == "bag" else small_log.write_csv(folder / "drive.csv")

        brakeline(["import", str(log), "--robot", str(robot)])
        brakeline(["certify", str(robot), "--use"])

        filter = Filter(ModelSet.load(folder / "data" / "my-robot" / "residual-one-step.safetensors"))
        print(f"a full stop from full speed is known to {100.0 * filter.half_width(filter.robot.high()):.0f} cm")
        decide(filter, 2.0)
        decide(filter, 0.4)


def decide(filter: Filter, distance: float) -> None:
    """Print the decision about driving at a pillar at full speed, for a robot that stands."""
    backup = BackupPlan(filter.robot)  # the committed plan and the input in force: store it between two decisions
    pillar = Shapes.of([Obstacle("cylinder", (distance, 0.0), (0.1,))], 2)
    answer = filter.decide(Request(np.zeros(5), np.array([0.4, 0.0]), backup.input_in_force, backup.plan, pillar))
    print(f"pillar at {distance} m: {answer.kind}, {answer.plan[0][0]:.2f} m/s")


if __name__ == "__main__":
    main(*sys.argv[1:])
