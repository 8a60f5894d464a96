"""Make a model set of your own robot from a ROS 2 bag, without ROS.

python examples/own_robot_from_bag.py       # writes a small bag first
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
        robot = folder / "my.toml"  # names, units, bounds, braking
        robot.write_text(small_log.DESCRIPTION)
        bag = small_log.write_bag(folder / "bag")  # /odom and /cmd_vel

        # The importer finds topics by their types. To name another one: --map v=/wheels/twist.linear.x
        brakeline(["import", str(bag), "--robot", str(robot)])
        certify = ["certify", str(robot), "--certificates", "residual", "--mode", "direct", "--use"]
        brakeline([*certify, "--accept-bound", "0.05"])  # from 12 minutes of data, the bound exceeds the limit of 1 %

        filter = Filter(ModelSet.load(folder / "data" / "my-robot" / "residual-direct.safetensors"))
        print(f"a full stop from full speed is known to {100.0 * filter.half_width(filter.robot.high()):.0f} cm")


if __name__ == "__main__":
    main()
