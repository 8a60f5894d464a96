"""Cut a quadrotor's link, or kill its vehicle server: measure how far braking leaves the verified set.

The last setpoint stays in force until the autopilot's timeout. The worst time is just before the next setpoint, after
the last one was sent again. The backup plan would brake meanwhile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import Figures
from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.actors.mavlink.autopilot_commands import AutopilotClient
from brakeline.actors.mavlink.lockstep_quadrotor import LockstepQuadrotor
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.model_set import ModelConfig
from brakeline.sim.arena import Arena
from brakeline.sim.autopilot.autopilot_rules import SETPOINT_TIMEOUT
from brakeline.sim.autopilot.endpoint import TICK, Autopilot
from brakeline.sim.delayed_vehicle import DelayedVehicle
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.quadrotor import Quadrotor
from brakeline.sim.scripted_policies import scripted
from brakeline.sim.vehicle import Vehicle

Array = NDArray[np.float64]

ROBOT, RULES = robot_with_task("quadrotor-late"), "px4"
TIMEOUTS = (0.2, 0.3, 0.5, 1.0)  # s; the last is PX4's default
POLICIES = ("astar", "greedy", "adversary")
FLIGHTS = 20  # of each policy and timeout
LONGEST = 40  # periods before the cut
BETWEEN = 21  # boxes from one period's end to the next, for what is swept
AFTER = 4.0  # s that the autopilot is watched for


def excess(positions: Array, center: Array, half: Array) -> Array:
    """Return how far positions (K, 3) are outside the boxes (N, 3) and the boxes between them: (K,) m."""
    shares = np.linspace(0.0, 1.0, BETWEEN)[:, None, None]
    centers, halves = ((a[:-1] + shares * (a[1:] - a[:-1])).reshape(-1, 3) for a in (center, half))
    return np.asarray((np.abs(positions[:, None] - centers) - halves).max(axis=2).min(axis=1))


class Loss:
    """Flights that end with the actor's death, behind an autopilot with one timeout."""

    def __init__(self, ask: Ask, timeout: float) -> None:
        self._ask_for, self._timeout = ask, timeout
        self._env = NavigationEnv(ROBOT, "default", self._vehicle, seed_key=77)
        self.collisions = 0

    def outside(self, policy: str, number: int) -> float:
        """Return how far the worst position after the actor's death is outside the tube of the backup plan [m]."""
        rng = np.random.default_rng(number)
        propose, driver = scripted(policy, ROBOT, rng), EpisodeRunner(ROBOT, self._env, ActorIdentity("actor", 0, 0))
        driver.begin(number)
        for _ in range(int(rng.integers(3, LONGEST))):
            outcome = driver.decide(propose(driver.observation, driver.info), self._ask_for)
            driver.execute(driver.backup_plan.plan[0], outcome)
            if not driver.running:
                break
        assert outcome is not None and outcome.answer is not None
        center, half = outcome.answer.tube_center, outcome.answer.tube_half_width
        positions = self._die(driver.backup_plan.plan[0])
        return float(excess(positions, center, half).max())

    def _die(self, input: Array) -> Array:
        """Send the last input for a period, and again at its end; return true positions (K, 3), one a tick."""
        endpoint = self._endpoint
        client = AutopilotClient(endpoint.receive)
        client.setpoint(input)
        endpoint.vehicle.begin_period()
        endpoint.advance(ROBOT.period - TICK)
        client.setpoint(input)
        endpoint.advance(TICK)
        positions = [endpoint.vehicle.state()[:3]]
        for _ in range(round(AFTER / TICK)):
            endpoint.advance(TICK)
            positions.append(endpoint.vehicle.state()[:3])
        self.collisions += endpoint.vehicle.collided
        return np.array(positions)

    def _vehicle(self, arena: Arena, rng: np.random.Generator) -> Vehicle:
        parameters = {SETPOINT_TIMEOUT[RULES]: self._timeout}
        self._endpoint = Autopilot(Quadrotor(arena, rng), RULES, parameters=parameters, quiet=True)
        return DelayedVehicle(LockstepQuadrotor(self._endpoint, ROBOT.in_lockstep()), ROBOT)


def run() -> Figures:
    ask = in_process(model_for(ROBOT, ModelConfig()))
    figures: Figures = {}
    for timeout in TIMEOUTS:
        loss = Loss(ask, timeout)
        outside = np.array([loss.outside(policy, number) for policy in POLICIES for number in range(FLIGHTS)])
        figures[f"setpoint timeout {timeout} s"] = {
            "flights": len(outside),
            "outside the tube": int((outside > 0.0).sum()),
            "p50 m": float(np.median(outside)),
            "worst m": float(outside.max()),
            "collisions": loss.collisions,
        }
    return figures
