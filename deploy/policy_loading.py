"""Load a policy by its name or file: scripted, stored with the program, untrained, own weights, or written inputs."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from inspect import isfunction, signature
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.data.sources.quantity_names import column_names
from brakeline.errors import BadInput, BadWeights, NoSource, UnknownTask
from brakeline.messaging.policy_weights import MLP, POLICY
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.task_code import is_own_code, load_code
from brakeline.safety.environment_views import copied
from brakeline.sim.scripted_policies import Policy, scripted

UNTRAINED, TRAINED = "untrained", "trained"
POLICY_FOLDER = Path(__file__).parents[1] / "policies"


def policy_named(name: str, robot: RobotWithTask, seed: int) -> Policy:
    """Return the policy with this name or file.

    Args:
        name: a scripted policy, a stored one (`trained` and others in policies/, or beside the task file), `untrained`,
            the folder of a run, a weights file, `FILE.py:NAME` for a class or function of your own, or a CSV file of
            inputs as `brakeline excite` prints them.
        seed: of scripted and untrained policies.

    Raises:
        ValueError: there is no such name or file.
        BadWeights: the file is no policy of this robot.
        UnknownTask: the code cannot be loaded, or makes no policy.
    """
    policies = robot.task.policies
    if name in policies:
        return scripted_with_copies(name, robot, np.random.default_rng(seed))
    if is_own_code(name):
        return _own_policy(name, robot, np.random.default_rng(seed))
    if name.endswith(".csv"):
        return replayed(Path(name), robot)
    return driving(network_named(name, robot, seed))


def _own_policy(place: str, robot: RobotWithTask, generator: np.random.Generator) -> Policy:
    """Return a function in a Python file, or the object that a class there makes for this robot, as a policy.

    Raises UnknownTask. The policy raises BadInput if it returns anything but an input.
    """
    make = load_code(place, Path())
    is_policy = isfunction(make) and [*signature(make).parameters][:1] == ["observation"]
    try:
        policy: Policy = make if is_policy else make(robot, generator)
    except TypeError as error:
        raise UnknownTask(
            f"{place} is no function of (observation, info), and it cannot be called with (robot, generator), as a "
            f"policy's class is: {error}"
        ) from error
    if not callable(policy):
        raise UnknownTask(f"an object of {place} cannot be called with (observation, info): define __call__")

    given_copies = _with_copies(policy)

    def checked(observation: NDArray[np.float32], info: dict[str, Any]) -> NDArray[np.float64]:
        action = np.asarray(given_copies(observation, info), dtype=float)
        if action.shape != (robot.action_dim,):
            inputs = ", ".join(robot.action)
            raise BadInput(
                f"{place} returned an array of shape {action.shape}: return {robot.action_dim} numbers ({inputs})"
            )
        return action

    return checked


def scripted_with_copies(name: str, robot: RobotWithTask, generator: np.random.Generator) -> Policy:
    """Return the policy that the robot's task names. If it is code of your own, it gets copies. Errors: `scripted`."""
    policy = scripted(name, robot, generator)
    return policy if type(policy).__module__.startswith("brakeline.") else _with_copies(policy)


def _with_copies(policy: Policy) -> Policy:
    """Return a policy that may overwrite what it gets: the next request is about the originals."""

    def given_copies(observation: NDArray[np.float32], info: dict[str, Any]) -> NDArray[np.float64]:
        return policy(copied(observation), copied(info))

    if hasattr(policy, "prepare"):  # a flight prepares such a policy for its goals
        given_copies.prepare = policy.prepare  # type: ignore[attr-defined]
    return given_copies


def network_named(name: str, robot: RobotWithTask, seed: int) -> MLP:
    """Return the network with this name or file; see `policy_named`."""
    if name == UNTRAINED:
        return MLP.untrained(robot, seed)
    stored = stored_policies(robot)
    path = stored.get(name) or _weights(name, robot)
    if path.is_dir():
        raise ValueError(
            f"the folder {path} holds no policy of {robot.kind}: name the folder of a training, or a weights file"
        )
    if not path.is_file():
        names = ", ".join([*sorted(stored), UNTRAINED, *robot.task.policies])
        raise ValueError(
            f"no policy is called {name!r} and no such file exists; there are: {names}, or the path of a weights file, "
            "of a run's folder, or FILE.py:CLASS"
        )
    if robot.late:
        with suppress(BadWeights):  # the weights may be of a training in lockstep
            return MLP.load(path, robot.in_lockstep())
    return MLP.load(path, robot)


def file_named(name: str, robot: RobotWithTask) -> Path | None:
    """Return the file of your own that `policy_named` reads; None if a policy has this name, whatever files exist."""
    if name in robot.task.policies or name == UNTRAINED or name in stored_policies(robot):
        return None
    return _weights(name, robot)


def policy_hash(name: str, robot: RobotWithTask) -> str:
    """Return a hash of the file of the policy with this name; empty if none is read (see `policy_named`)."""
    path = stored_policies(robot).get(name) or _weights(name, robot)
    scripted_or_new = name in robot.task.policies or name == UNTRAINED
    return "" if scripted_or_new else hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _weights(name: str, robot: RobotWithTask) -> Path:
    """Return the path of a file, or of the policy in the folder of a run, which may have a learner for each robot."""
    path = Path(name)
    learners = "learner", f"learner-{robot.name.replace('.', '_')}"
    learned = (path / learner / POLICY for learner in learners)
    return next((file for file in learned if file.is_file()), path)


def stored_policies(robot: RobotWithTask) -> dict[str, Path]:
    """Return the files of the stored policies by name: in policies/, and beside the task file of your own robot."""
    task = robot.task
    beside = task.folder / f"{TRAINED}.safetensors"
    folder = POLICY_FOLDER / (task.name or robot.kind)
    return {path.stem: path for path in folder.glob("*.safetensors")} | ({TRAINED: beside} if beside.is_file() else {})


def driving(mlp: MLP) -> Policy:
    """Return a network as a policy, without exploration."""
    return lambda observation, info: mlp(observation)


def replayed(path: Path, robot: RobotWithTask) -> Policy:
    """Return the inputs in a CSV file as a policy, one row a control period and one run an episode. It ends at rest.

    Raises:
        NoSource: the file can't be read, or lacks an input of the robot.
    """
    from brakeline.deploy.data.importer import tables_of  # imports pyarrow, which no other policy needs

    (table,) = tables_of(path)
    names = column_names(robot)[1]
    if missing := [name for name in names if name not in table.columns]:
        raise NoSource(f"{path}: no column {', '.join(missing)}; there are: {', '.join(table.columns)}")
    inputs = np.stack([table.columns[name] for name in names], axis=1)
    runs = iter([inputs[table.run == run] for run in np.unique(table.run)])
    left: list[NDArray[np.float64]] = []

    def policy(observation: NDArray[np.float32], info: dict[str, Any]) -> NDArray[np.float64]:
        if info["time"] == 0.0:
            left[:] = list(next(runs, np.zeros((0, len(names)))))
        return left.pop(0) if left else np.where(robot.zero_at_rest, 0.0, info["input_in_force"])

    return policy
