"""safe-control-gym's cart-pole with its own constraints, and the velocity loop that makes it a robot for the filter."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
import safe_control_gym
from safe_control_gym.envs.gym_control.cartpole import CartPole

from examples.safe_control_gym.velocity_loop import Array

SAMPLES = 5  # states that a period's path has
PUSH = 0.1  # N, largest random force on the pole in the disturbed task; it is constant for one control step
# The task of the authors' example of a safety filter (examples/mpsc/config_overrides/cartpole/cartpole_track.yaml), but
# it starts within its constraints: there the pole starts at up to 0.2 rad, and the constraint is 0.18 rad.
TASK: dict[str, Any] = {
    "ctrl_freq": 15,
    "pyb_freq": 750,
    "episode_len_sec": 10,
    "inertial_prop": {"pole_length": 0.5, "cart_mass": 1, "pole_mass": 0.1},
    "init_state": dict.fromkeys(("init_x", "init_x_dot", "init_theta", "init_theta_dot"), 0.0),
    "init_state_randomization_info": {
        name: {"distrib": "uniform", "low": -most, "high": most}
        for name, most in {"init_x": 1.0, "init_x_dot": 0.1, "init_theta": 0.1, "init_theta_dot": 0.1}.items()
    },
    "task": "traj_tracking",
    "cost": "rl_reward",
    "obs_goal_horizon": 1,
    "rew_state_weight": [1, 0.01, 0.01, 0.01],
    "rew_act_weight": 0.01,
    "constraints": [
        {
            "constraint_form": "default_constraint",
            "constrained_variable": "state",
            "upper_bounds": [2, 2, 0.18, 2],
            "lower_bounds": [-2, -2, -0.18, -2],
        },
        {"constraint_form": "default_constraint", "constrained_variable": "input"},
    ],
}


class SampledCartPole(CartPole):
    """The environment, with the states within each control step in `path` (SAMPLES, 4)."""

    def _advance_simulation(self, force: float) -> None:
        steps, disturbances = self.PYB_STEPS_PER_CTRL, self.disturbances
        if "dynamics" in disturbances:  # one draw for the whole control step, as without samples
            self.disturbances = {"dynamics": Constant(disturbances["dynamics"].apply(np.zeros(2), self))}
        self.PYB_STEPS_PER_CTRL = steps // SAMPLES
        path = []
        for _ in range(SAMPLES):
            super()._advance_simulation(force)
            path.append(self.physical_state())
        self.PYB_STEPS_PER_CTRL, self.disturbances, self.path = steps, disturbances, np.array(path)

    def physical_state(self) -> Array:
        """Return the state that the simulator has now."""
        joints = [pybullet.getJointState(self.CARTPOLE_ID, i, physicsClientId=self.PYB_CLIENT)[:2] for i in (0, 1)]
        return np.concatenate(joints)


class Constant:
    """A disturbance that adds the same force each time."""

    def __init__(self, force: Array) -> None:
        self.force = force

    def apply(self, target: Array, env: Any) -> Array:
        return target + self.force


def make(amplitude: float = 1.0, disturbed: bool = False, **changes: Any) -> SampledCartPole:
    """Make the environment. Its action is a force [N].

    Args:
        amplitude: m, of the reference, a sine of the cart's position with two cycles in an episode.
        disturbed: push the pole by a random force in each control step.
        changes: other arguments of the environment.
    """
    reference = {"trajectory_type": "circle", "trajectory_plane": "zx", "num_cycles": 2, "trajectory_scale": amplitude}
    task = {"stabilization_goal": [0, 0], "stabilization_goal_tolerance": 0.05, "trajectory_position_offset": [0, 0]}
    pushes = {"dynamics": [{"disturbance_func": "uniform", "low": [-PUSH, 0.0], "high": [PUSH, 0.0]}]}
    words = TASK | {"task_info": reference | task, "output_dir": tempfile.gettempdir()}
    return SampledCartPole(**words | ({"disturbances": pushes} if disturbed else {}) | changes)


def source() -> Path:
    """Return the authors' repository, which also holds their trained policies."""
    return Path(safe_control_gym.__file__).parents[1]
