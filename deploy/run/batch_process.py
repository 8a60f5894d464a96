"""PROCESS: train from many simulated robots in the learner's process, a loop around `BatchTrainer`.

The log has every step and episode, as other runs have. It has no exchanges: a request and a decision of each step
would take more time than the step. So `replay` has nothing to compare, and `analyse` no figures of single decisions.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from brakeline.deploy.run.batch_trainer import BatchTrainer
from brakeline.deploy.run.processes import ProcessSpec
from brakeline.deploy.run.run_config import RunConfig
from brakeline.deploy.run.run_models import model_in_run
from brakeline.errors import BadModel
from brakeline.learner.checkpoint import CHECKPOINT
from brakeline.learner.learner import Learner
from brakeline.learner.learner_output import LearnerOutput
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.messaging.topics import EPISODE, STEP
from brakeline.safety.filter.filter import Filter
from brakeline.safety.methods import load
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.signature import TrustedSigners

log = logging.getLogger("brakeline.learner")

PUBLISHED = (STEP, EPISODE)  # topics of each robot


def main(bus: BusSettings, config: RunConfig, folder: Path, spec: ProcessSpec, resume: bool) -> bool:
    """Train until the last step of the run, SIGINT or SIGTERM. Write a checkpoint and a policy file at the end.

    Returns:
        Whether the run is complete.

    Raises:
        CheckpointError: the run cannot be resumed.
        BadModel: the run has no model set of this robot.
        Diverged: the weights are no longer finite; the last checkpoint and policy stay.
        Unreachable: no router answers.
    """
    robot = robot_with_task(spec.robot)
    safety = _filter(bus, config, folder, robot) if config.filtered else None
    with Process(bus, spec.name) as process:
        learner = Learner(robot, config.learning(), incarnation=process.bus.run)
        if resume:
            learner.restore(folder / spec.name / CHECKPOINT)
            log.info("resumed at step %d, update %d", learner.steps, learner.updates)
        output = LearnerOutput(process, learner, folder / spec.name)
        trainer = BatchTrainer(
            learner,
            safety,
            config.robots_per_actor,
            spec.name,
            _publish_for_robots(process, robot, spec.name, config.robots_per_actor),
            arena=config.arena,
            seed=config.seed,
            penalty=config.penalty,
            accept_bound=config.accept_bound,
            conditions=config.conditions,
        )
        process.announce()
        try:
            while not process.stop.is_set() and not learner.done:
                trainer.period()
                output.save_if_due()
                output.publish_if_due()
        finally:
            trainer.close()
        if learner.weights_due():
            learner.publish()
        output.save()
        output.publish()
        return learner.done


def _filter(bus: BusSettings, config: RunConfig, folder: Path, robot: RobotWithTask) -> Filter:
    """Return the filter with the run's model set. Raises BadModel: the run has no model set of this robot."""
    trust = None if bus.keys is None else TrustedSigners.load(bus.keys)
    model = load(model_in_run(config, folder, robot, trust))
    if not isinstance(model, ModelSet):
        raise BadModel(f"the model of {robot.name} is no model set, which --backend batch needs")
    return Filter(model)


def _publish_for_robots(
    process: Process, robot: RobotWithTask, name: str, robots: int
) -> Callable[[int, pb.Step | pb.Episode], None]:
    """Return a function that publishes a message of the robot with a number, which is a source of its own."""
    publishers = [
        {topic.message: process.bus.publisher(topic, robot=robot.name, source=f"{name}.{i}") for topic in PUBLISHED}
        for i in range(robots)
    ]

    def publish(number: int, message: pb.Step | pb.Episode) -> None:
        publishers[number][type(message)].put(message)

    return publish
