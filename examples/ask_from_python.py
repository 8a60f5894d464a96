"""Ask a running safety service about every action of your own policy.

brakeline safety ground --listen tcp/127.0.0.1:7447      # in another terminal; wait until it prints `ready`
python examples/ask_from_python.py tcp/127.0.0.1:7447
"""

import sys

from brakeline import BusError, Obstacle, SafetyClient


def main(endpoint: str, deadline: float = 0.1) -> None:
    state = [0.0, 0.0, 0.0, 0.0, 0.0]  # x, y, heading, speed, turn rate, as your robot measures them
    obstacles = [Obstacle("cylinder", (0.6, 0.0), (0.1,))]  # within your robot's sight
    with SafetyClient.open(endpoint, "ground", deadline) as safety:
        for period in range(15):
            action = [0.25, 0.0]  # your policy: drive at the cylinder at full speed
            try:
                answer = safety.decide(state, action, obstacles)
                speed, turn_rate = answer.action
                print(f"{period:2d}  {answer.kind:9s} {speed:.3f} m/s {turn_rate:+.3f} rad/s  x = {state[0]:.3f} m")
            except BusError as error:  # no answer in time: brake along the backup plan
                speed, turn_rate = safety.fallback()
                print(f"{period:2d}  fallback  {speed:.3f} m/s: {error}")
            state = [state[0] + 0.2 * speed, 0.0, 0.0, speed, turn_rate]  # your robot drives


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447")
