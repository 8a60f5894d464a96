"""Register the environments with Gymnasium: `gymnasium.make("brakeline/Ground-v0", arena="dense")`."""

from __future__ import annotations

import gymnasium

ENVIRONMENTS = {"brakeline/Ground-v0": "ground", "brakeline/Quadrotor-v0": "quadrotor"}  # the robot of each id


def register() -> None:
    """Register every environment id that Gymnasium does not know yet.

    `gymnasium.make` passes its other arguments on to `NavigationEnv`: `arena`, `conditions`, `render_mode`, ...
    `gymnasium.make_vec` makes a `BatchNavigationEnv`, unless you give it another `vectorization_mode`.
    """
    for name, robot in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="brakeline.sim.navigation_env:NavigationEnv",
                vector_entry_point="brakeline.sim.batch.batch_env:BatchNavigationEnv",
                kwargs={"robot": robot},
            )
