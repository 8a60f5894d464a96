"""What the log of a run holds besides messages: its configuration, versions, conditions, and the models in use."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

from brakeline.deploy.data.data_paths import method_path
from brakeline.deploy.run.run_config import RunConfig, encode
from brakeline.logs.mcap_container import model_attachment_name
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import robot_maybe_with_task
from brakeline.safety.methods import DDPC, load


def metadata(config: RunConfig) -> dict[str, dict[str, str]]:
    """What the log says of its run, besides the messages."""
    filtered = config.filtered
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
    about = {
        "run": run,
        "configuration": {"json": encode(config)},
        "versions": {name: version(name) for name in packages},
        "conditions": config.conditions.describe(),
    }
    robots = [robot_maybe_with_task(name) for name in config.robots]
    about["robots"] = {robot.kind: json.dumps(robot.description) for robot in robots}
    for robot in robots if filtered else ():
        model = load(method_path(robot, config.method, config.model_config))
        about[f"model {robot.name}"] = {"version": model.version, **model.about}
    return about


def attachments(config: RunConfig, folder: Path) -> dict[str, bytes]:
    """The models in use when the log begins, or before (of a run that goes on), so that it alone can be replayed."""
    if not config.filtered:
        return {}
    models = (
        load(method_path(robot_maybe_with_task(robot), config.method, config.model_config)) for robot in config.robots
    )
    files = {model_attachment_name(model.robot.name, model.version): model.encode() for model in models}
    for robot in (robot_named(name).name for name in config.robots):
        archived = (folder / robot / "models").glob("*.safetensors")
        files |= {model_attachment_name(robot, path.stem): path.read_bytes() for path in archived}
    return files
