"""Get decisions about your own robot from a log of it, in CSV or as a ROS 2 bag: two commands and four lines.

python examples/own_robot_from_log.py           # writes a small log in CSV first
python examples/own_robot_from_log.py bag       # writes a small bag first; ROS is not needed
"""

import os
import sys
import tempfile
from pathlib import Path

import small_log

from brakeline import Filter, InProcess, Obstacle
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

        filter = Filter.load(folder / "data" / "my-robot" / "residual-one-step.safetensors", robot)
        print(f"a full stop from full speed is known to {100.0 * filter.half_width(filter.robot.high()):.0f} cm")
        safety = InProcess(filter)
        decide(safety, 2.0)
        decide(safety, 0.4)


def decide(safety: InProcess, distance: float) -> None:
    """Print the decision about driving at a pillar at full speed, for a robot that stands."""
    safety.reset()  # once, when the robot stands; then call `decide` once a period, and execute `answer.action`
    pillar = Obstacle("cylinder", (distance, 0.0), (0.1,))  # in the frame of the state: list all within `sight`
    answer = safety.decide(state=[0.0, 0.0, 0.0, 0.0, 0.0], action=[0.4, 0.0], obstacles=[pillar])
    print(f"pillar at {distance} m: {answer.kind}, {answer.action[0]:.2f} m/s")


if __name__ == "__main__":
    main(*sys.argv[1:])
