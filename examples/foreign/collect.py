"""Records a robot where nothing costs. python collect.py car OUT.safetensors 20000"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from brakeline.deploy.data.environment_episodes import collect
from examples.foreign.robots import adapter_of


def main(robot: str, out: str, periods: str = "20000") -> None:
    adapter = adapter_of(robot)
    env, how = adapter.make(free=True), {"held": adapter.held, "actions": adapter.actions()}
    data = collect(env, adapter.robot, int(periods), **how)
    data.save(Path(out))
    print(
        f"{out}: {data.periods} periods in {len(data.trajectories)} trajectories, "
        f"chord deviation {1e3 * data.chord_deviation:.2f} mm"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
