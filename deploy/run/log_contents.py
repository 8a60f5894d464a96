"""Collect what the log of a run holds besides messages: configuration, versions, conditions, models, pictures."""

from __future__ import annotations

import json
import logging
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from brakeline.deploy.run.run_config import RunConfig, encode
from brakeline.deploy.run.run_models import model_in_run
from brakeline.errors import BadModel
from brakeline.logs.foxglove import FoxgloveConverter
from brakeline.logs.mcap_container import model_attachment_name
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.logs.recorder import Derive
from brakeline.logs.segment import Entry
from brakeline.messaging.bus import Sample
from brakeline.messaging.robot import Robot, robot_named
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.messaging.topics import FRAMES
from brakeline.safety.methods import Model, load
from brakeline.safety.model.model_config import DDPC

log = logging.getLogger("brakeline.recorder")

ENCODING = "application/json;mavlink"


def metadata(config: RunConfig, folder: Path) -> dict[str, dict[str, str]]:
    """Return the metadata of the log of the run in a folder: named groups of named texts."""
    run = {
        "method": config.method,
        "policy": config.policy or "learning",
        "arena": config.arena,
        "seed": str(config.seed),
        "robots": ",".join(robot_named(name).name for name in config.robots),
    }
    if config.method == DDPC:
        run |= {"certificate": config.model_config.certificate, "mode": config.model_config.mode}
    packages = ("brakeline", "mujoco", "proxsuite", "numpy", "torch", "eclipse-zenoh", "mcap")
    groups = {
        "run": run,
        "configuration": {"json": encode(config)},
        "versions": {name: _version(name) for name in packages},
        "conditions": config.conditions.describe(),
    }
    robots = [robot_maybe_with_task(name) for name in config.robots]
    groups["robots"] = {robot.kind: json.dumps(robot.description) for robot in robots}
    for robot in robots if config.filtered else ():
        if (model := _model(config, folder, robot)) is not None:
            groups[f"model {robot.name}"] = {"version": model.version, **model.about}
    return groups


def _version(package: str) -> str:
    """Return the version of a package, which may be one that this run does not need."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _model(config: RunConfig, folder: Path, robot: Robot) -> Model | None:
    """Return the model that the run uses; None if it is no longer readable, which must not end the recorder."""
    try:
        return load(model_in_run(config, folder, robot))
    except BadModel as error:
        log.error("model not in the log: %s", error)
        return None


def attachments(config: RunConfig, folder: Path) -> dict[str, bytes]:
    """Return the files of all models that the run uses or has used, so that the log alone suffices for a replay."""
    if not config.filtered:
        return {}
    files = {}
    for name in config.robots:
        if (model := _model(config, folder, robot_maybe_with_task(name))) is not None:
            files[model_attachment_name(model.robot.name, model.version)] = model.encode()
        robot = robot_named(name).name
        for path in sorted((folder / robot / "models").glob("*.safetensors")):
            try:
                files[model_attachment_name(robot, path.stem)] = path.read_bytes()
            except OSError as error:  # the log has then no model for the decisions that this one made
                log.error("model not in the log: %s: %s", path, error)
    return files


def derive_entries(pictures: float, robots: RecordedRobots | None = None) -> Derive:
    """Return the function that adds pictures for Foxglove, and MAVLink frames as JSON, to the log.

    Args:
        pictures: a second and robot; 0: none.
        robots: the robots of the run, if they are known before the first message.
    """
    if pictures == 0.0:
        return frames_as_json
    draw = FoxgloveConverter(pictures, robots).from_sample
    return lambda sample: [*draw(sample), *frames_as_json(sample)]


def frames_as_json(sample: Sample) -> list[Entry]:
    """Return a JSON entry for each frame of a FRAMES message, with the frame's time. Other messages give none.

    Other recorders do the same, on the channel `mavlink/SYSTEM/COMPONENT/MESSAGE`:
    {"header": {"system_id": 1, "component_id": 1, "sequence": 7}, "message": {"type": "HEARTBEAT", …}}

    Raises:
        Malformed: the message can't be decoded.
        ValueError: the time of a frame can't be stored.
    """
    if sample.topic is not FRAMES:
        return []
    from brakeline.actors.mavlink.frame_log import decode_frame  # needs pymavlink, which other robots do not

    entries = []
    for frame in sample.message().frames:
        message = decode_frame(frame.raw, frame.outgoing)
        if message is not None:
            text = json.dumps(message.described).encode()
            entries.append(Entry(message.name, ENCODING, text, sample.received, frame.wall_time, 0))
    return entries
