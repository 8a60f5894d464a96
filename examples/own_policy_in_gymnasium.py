"""Put the filter before your own policy in your own environment, with a model set from the environment's data."""

import gymnasium
import numpy as np

from brakeline import (
    Filter,
    ModelConfig,
    Obstacle,
    SafetyWrapper,
    certify,
    collect,
    normalised,
    robot_from_description,
)


class Cart(gymnasium.Env):
    """A cart that reaches a commanded velocity of up to 1 m/s within some tenths of a second; a wall is at x = 1 m."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        self.state = np.zeros(4)  # x, y [m], vx, vy [m/s]
        return self.state, {}

    def step(self, action):
        velocity = 0.5 * (self.state[2:] + action)
        self.state = np.concatenate([self.state[:2] + 0.1 * velocity, velocity])
        return self.state, 0.0, False, False, {}


def speed(**more):
    return {"unit": "m/s"} | more


robot = robot_from_description(
    {
        "name": "cart",
        "period": 0.1,
        "sight": 3.0,
        "state": {axis: {"unit": "m", "role": "position", "error": 0.0} for axis in "xy"}
        | {"vx": speed(error=0.0, follows="to vx"), "vy": speed(error=0.0, follows="to vy")},
        "input": {"to vx": speed(low=-1.0, high=1.0), "to vy": speed(low=-1.0, high=1.0)},
        "plan": {"horizon": 6, "brake": 1},
        "body": [{"at": [0.0, 0.0], "radius": 0.2}],
    }
)
views = {"state": lambda env, observation, info: observation, "actions": normalised(robot)}
data = collect(Cart(), robot, 25_000, **views)  # enough held-out plans for a bound within the robot's limit
model, report = certify(data, ModelConfig())
env = SafetyWrapper(Cart(), Filter(model), obstacles=lambda *_: [Obstacle("wall", (1.0, 0.0), yaw=np.pi)], **views)

observation, _ = env.reset()
for _ in range(50):
    observation, reward, terminated, truncated, info = env.step(np.array([1.0, 0.2]))  # your policy: drive at the wall
distance, kind = 1.0 - observation[0], info["diagnostics"]["kind"]
print(f"The policy wants to drive through the wall. The cart stands {distance:.3f} m before it: {kind}")
