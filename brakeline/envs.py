"""Importing this module registers the environments with Gymnasium. `import brakeline` does so if Gymnasium is loaded.

>>> import gymnasium
>>> env = gymnasium.make("brakeline.envs:brakeline/Ground-v0", arena="dense")
>>> env.observation_space.shape
(26,)
"""

from brakeline.sim.registration import register

register()
