"""THE table of a run's processes, and the files of its folder that they share."""

from __future__ import annotations

from dataclasses import dataclass

from deploy.run.configurations import RunConfig

CONFIG, ENDPOINT, LOG = "config.json", "endpoint", "run.mcap"
UNFINISHED = 75  # exit status: asked to end before its work was done


@dataclass(frozen=True)
class Place:
    """A process's name, and how it is called on in a run."""

    name: str
    kind: str  # a key of KINDS
    robot: str = ""
    number: int = 0
    nice: int = 0  # the robot's safety comes before learning


def places(config: RunConfig) -> list[Place]:
    """THE table of a run's processes, in the order in which they start."""
    table = [Place("recorder", "recorder", nice=5 if config.flight is not None else 0)] if config.record else []
    if config.filtered:
        table += [Place(f"safety-{i}", "safety") for i in range(config.replicas)]
    if config.autopilot is not None:
        table.append(Place("autopilot", "autopilot"))
    one = len(config.robots) == 1
    for robot in config.robots:
        if not config.policy:
            table.append(Place("learner" if one else f"learner-{robot}", "learner", robot, nice=10))
        if config.from_logs:
            table.append(Place("feeder" if one else f"feeder-{robot}", "feeder", robot, nice=2))
        for i in range(config.actors):
            name = f"actor-{i}" if one else f"actor-{robot}-{i}"
            nice = 0 if config.flight is not None else 2
            table.append(Place(name, "actor", robot, i * config.robots_per_actor, nice))
    return table
