"""Record a data set of a robot where nothing costs. python collect.py car OUT.safetensors 20000"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from brakeline import collect
from examples.foreign.adapter import load_adapter


def main(robot: str, out: str, periods: str = "20000") -> None:
    adapter = load_adapter(robot)
    env = adapter.make(free=True)
    data = collect(env, adapter.robot, int(periods), held=adapter.held, actions=adapter.actions())
    data.save(Path(out))
    print(
        f"{out}: {data.periods} periods in {len(data.trajectories)} trajectories, "
        f"chord deviation {1e3 * data.chord_deviation:.2f} mm"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
