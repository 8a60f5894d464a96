"""Records a robot in its task without hazards: nothing there costs. python collect.py car OUT.safetensors"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from deploy.data.episodes import collect
from examples.safety_gymnasium import adapter


def main(name: str, out: str, periods: str = "30000") -> None:
    robot = adapter.robot_of(name)
    env = adapter.make(f"Safety{name.title()}Goal0-v0", robot)
    data = collect(env, robot, int(periods), held=25, state=adapter.state, actions=adapter.actions(robot))
    data.save(Path(out))
    print(f"{out}: {data.periods} periods in {len(data.trajectories)} trajectories, bulge {1e3 * data.bulge:.2f} mm")


if __name__ == "__main__":
    main(*sys.argv[1:])
