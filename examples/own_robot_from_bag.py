"""From a ROS 2 bag of your own robot to a model set of it; no ROS is needed.

python examples/own_robot_from_bag.py       # makes a small bag of its own first
"""

import os
import tempfile
from pathlib import Path

import small_log

from brakeline import Filter, ModelSet
from brakeline.deploy.cli import main as brakeline


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["BRAKELINE_DATA"] = str(folder / "data")
        robot = folder / "my.toml"  # names, units, bounds, how it brakes
        robot.write_text(small_log.DESCRIPTION)
        bag = small_log.write_bag(folder / "bag")  # /odom and /cmd_vel

        # Topics are found by what they hold; another one is named so: --map v=/wheels/twist.linear.x
        brakeline(["import", str(bag), "--robot", str(robot)])
        certify = ["certify", "--robot", str(robot), "--certificates", "residual", "--mode", "direct", "--use"]
        brakeline([*certify, "--accept-bound", "0.05"])  # 12 minutes state more than the limit of 1 %: it is accepted

        ready = Filter(ModelSet.load(folder / "data" / "my-robot" / "residual-direct.safetensors"))
        print(f"a full stop from full speed is known to {100.0 * ready.half_width(ready.robot.high()):.0f} cm")


if __name__ == "__main__":
    main()
