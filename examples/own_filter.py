"""A safety filter of your own for `evaluate` and `compare`. It limits the speed near obstacles.

brakeline evaluate ground --policy greedy --method examples/own_filter.py:SpeedLimit
brakeline compare ground --methods ddpc examples/own_filter.py:SpeedLimit --seeds 0 --results results/mine
"""

import numpy as np

from brakeline import OwnFilter

DECELERATION = 0.2  # m/s², with which the robot is trusted to stop


class SpeedLimit(OwnFilter):
    """Limit the speed such that the robot could stop before the nearest obstacle of the map, wherever that is."""

    def safe_input(self, request, proposal):
        distances = request.obstacles.distance(request.state[:2]) - self.robot.footprint  # m
        free = max(distances.min(initial=np.inf), 0.0)
        fastest = np.sqrt(2.0 * DECELERATION * free)
        return np.array([min(proposal[0], fastest), proposal[1]])  # m/s, rad/s
