"""A short log of a robot that a greedy policy drives through the filter, made without processes or a bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import numpy as np

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner, RobotGroup, run_episode
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.vehicle_factory import environment
from brakeline.logs.mcap_container import model_attachment_name
from brakeline.logs.recorder import entry
from brakeline.logs.segment import open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.topics import EPISODE, EXCHANGE, STEP, Topic
from brakeline.safety.model.model_set import ModelConfig
from brakeline.sim.scripted_policies import Policy, scripted
from tests.robots import GROUND

Change = Callable[[pb.Exchange], None]


def episode(driver: EpisodeRunner, policy: Policy, ask: Ask | None, number: int) -> Iterator[pb.Step]:
    """Yield the steps of one episode of a robot that is alone."""
    for (step,) in run_episode(RobotGroup([driver]), [policy], ask, number):
        yield step


def drive(
    log: Path,
    steps: int = 150,
    change: Change | None = None,
    attach: bool = True,
    actor: str = "actor-0",
    run: int = 1,
) -> str:
    """Drive and record; `change` may falsify what is recorded of an exchange. Returns the model set's version."""
    model = model_for(GROUND, ModelConfig())
    ask = in_process(model)
    driver = EpisodeRunner(GROUND, environment(GROUND, "dense", 7), ActorIdentity(actor, 0, 0), penalty=1.0)
    attachments = {model_attachment_name("ground", model.version): model.encode()} if attach else None
    segment = open_segment(log, {"run": {"method": "ddpc"}}, attachments)
    numbers: dict[str, Iterator[int]] = {}

    def put(topic: Topic, message: pb.Episode | pb.Exchange | pb.Step) -> None:
        key = topic.at(robot="ground", source=actor)
        number = next(numbers.setdefault(key, count(1)))
        now = time.time_ns()
        message.header.MergeFrom(pb.Header(sequence=number, source=actor, run=run, wall_time=now))
        segment.save([entry(Sample(topic, key, message.SerializeToString(), now))])

    policy, episode = scripted("greedy", GROUND, np.random.default_rng(0)), 0
    for _ in range(steps):
        if not driver.running:
            put(EPISODE, driver.begin(episode))
            episode += 1
        proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
        outcome = driver.decide(proposal, ask)
        assert outcome is not None
        exchange = outcome.exchange(driver.info["time"])
        if change is not None:
            change(exchange)
        put(EXCHANGE, exchange)
        put(STEP, driver.execute(proposal, outcome, 5))
    segment.finish()
    return model.version
