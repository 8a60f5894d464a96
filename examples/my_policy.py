"""Put the filter in front of your own policy: drive the same ten episodes without it and with it.

python examples/my_policy.py
"""

import gymnasium
import numpy as np

from brakeline import Filter, SafetyWrapper


def my_policy(state, goal):
    """Turn towards the goal, then drive at full speed. This policy knows nothing about obstacles."""
    x, y, heading = state[:3]  # m, m, rad
    off = np.arctan2(goal[1] - y, goal[0] - x) - heading
    off = (off + np.pi) % (2 * np.pi) - np.pi
    speed = 0.25 if abs(off) < 0.5 else 0.0  # m/s
    return np.array([speed, np.clip(off, -0.5, 0.5)])  # rad/s


def drive(env, episodes=10):
    """Return how many episodes ended at the goal and with a collision, and the steps that the filter changed."""
    goals = collisions = changed = 0
    for seed in range(episodes):
        _, info = env.reset(seed=seed)
        ended = False
        while not ended:
            _, _, terminated, truncated, info = env.step(my_policy(info["state"], info["goal"]))
            ended = terminated or truncated
            changed += "safety" in info and info["safety"].kind != "allowed"
        goals, collisions = goals + info["at_goal"], collisions + info["collision"]
    return f"{goals} goals, {collisions} collisions, {changed} steps changed"


def main():
    env = gymnasium.make("brakeline.envs:brakeline/Ground-v0", arena="dense")
    print("without the filter:", drive(env))
    print("with the filter:   ", drive(SafetyWrapper(env, Filter.load("ground"))))


if __name__ == "__main__":
    main()
