"""Load the code that a task's file names: simulators, observations and scripted policies."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from brakeline.errors import UnknownTask
from brakeline.extras import missing_extra

# Where task files of version 0.2 look for code, and where it is now.
FORMER_PLACES = {
    "deploy.quadrotors:behind_px4": "brakeline.deploy.quadrotor_vehicles:behind_px4",
    "deploy.quadrotors:embedded": "brakeline.deploy.quadrotor_vehicles:embedded",
    "sim.ground:simulated": "brakeline.sim.ground_robot:simulated",
    "sim.senses:AirSenses": "brakeline.sim.observations:QuadrotorObservation",
    "sim.senses:GroundSenses": "brakeline.sim.observations:GroundObservation",
    "sim.senses:PlanarSenses": "brakeline.sim.observations:PlanarObservation",
    "sim.senses:TrackingSenses": "brakeline.sim.observations:TrackingObservation",
    "sim.policies:RandomInputs": "brakeline.sim.scripted_policies:RandomPolicy",
    "sim.policies:Greedy": "brakeline.sim.scripted_policies:GroundGreedyPolicy",
    "sim.policies:Adversary": "brakeline.sim.scripted_policies:GroundAdversary",
    "sim.policies:MapDriver": "brakeline.sim.scripted_policies:GroundRoutePolicy",
    "sim.policies:CarefulDriver": "brakeline.sim.scripted_policies:GroundCarefulPolicy",
    "sim.pilots:GreedyPilot": "brakeline.sim.quadrotor_policies:QuadrotorGreedyPolicy",
    "sim.pilots:HostilePilot": "brakeline.sim.quadrotor_policies:QuadrotorAdversary",
    "sim.pilots:MapPilot": "brakeline.sim.quadrotor_policies:QuadrotorRoutePolicy",
    "sim.pilots:CarefulPilot": "brakeline.sim.quadrotor_policies:QuadrotorCarefulPolicy",
}


def is_own_code(name: str) -> bool:
    """Return whether the name of a policy or a method is a place in a Python file: `FILE.py:CLASS`."""
    return ".py:" in name


def load_code(place: str, folder: Path) -> Any:
    """Import the object at `module:name`, or at `file.py:name` in the folder of the task's file.

    Raises:
        MissingExtra: the object needs a package that an extra brings.
        UnknownTask: the object cannot be imported.
    """
    module, _, name = FORMER_PLACES.get(place, place).partition(":")
    try:
        loaded = _module_in(folder / module) if module.endswith(".py") else importlib.import_module(module)
        if not hasattr(loaded, name):
            raise AttributeError(f"{module} has no {name!r}")
        return getattr(loaded, name)
    except (ImportError, AttributeError, OSError) as error:
        if isinstance(error, ModuleNotFoundError) and (missing := missing_extra(error)):
            raise missing from error
        raise UnknownTask(f"{place!r} is no code that can be loaded: {error}") from error
    except Exception as error:  # whatever the file does when it is executed
        raise UnknownTask(f"{place!r} is no code that can be loaded: {type(error).__name__}: {error}") from error


def _module_in(path: Path) -> Any:
    """Import the module in a file; each file is executed once."""
    name = f"task_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ImportError(f"{path} is no Python file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]  # else the next one would find half of it
            raise
    return sys.modules[name]
