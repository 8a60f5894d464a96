"""Model sets: everything that the filter knows about a robot, from recorded data (docs/method.md §1, §2)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadModel, UnknownRobot
from brakeline.messaging.acceleration_age import acceleration_age_in
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot import FORMER_LAYOUTS, Array, Robot, refuse_shipped_name, robot_named
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.stated_share import percent
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.filter.reachable_tube import Tube, recursion_maps, stack_direct, stack_recursive, stack_rollout
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.model_config import DIRECT as DIRECT
from brakeline.safety.model.model_config import FREE, PLAN
from brakeline.safety.model.model_config import ONE_STEP as ONE_STEP
from brakeline.safety.model.model_config import RECURSION as RECURSION
from brakeline.safety.model.model_config import ModelConfig as ModelConfig
from brakeline.safety.model.one_step import OneStep
from brakeline.safety.model.tensor_file import content, pack, unpack
from brakeline.safety.model.turning_in_place import InPlace
from brakeline.safety.model.windows import plan_regressor_map

ENTRY, CHECKSUM = "model_set", "checksum"  # old files have no checksum
SHIPPED = Path(__file__).parents[2] / "robots"  # model sets lie beside the descriptions of their robots
TENSORS = ("C", "W", "M", "kappa", "w", "generators")
IN_PLACE, BOX = "in_place.step", "in_place.box"  # optional


@dataclass(frozen=True)
class ModelSet:
    """The predictors of a robot with all their error bounds; its version is a hash of the content.

    Attributes:
        steps: in the modes direct and one-step, bound k is about k+1 periods from z; in mode recursion, about period k
            from z_k. In mode one-step they have no predictor (zeros): `one_step` predicts.
        chord_deviations: N rows, β_k(z). stopping_distance: one row, σ(z). In files: "bulges" and "latch".
    """

    robot: Robot
    model_config: ModelConfig
    steps: tuple[ErrorBound, ...]
    chord_deviations: ErrorBound
    stopping_distance: ErrorBound
    domain: Array  # (2, regressor_dim): smallest and largest recorded [x_0; input in force]
    basis: Array  # (nz, nz): coordinates in which the recorded z are white
    about: dict[str, str]
    layout: str = ""  # layout of the robot, for model sets older than descriptions in files
    stands: int = 0  # periods after which a plan has brought the robot to a stand; 0: at its end
    in_place: InPlace | None = None  # predictors for plans in place, if the data support them
    one_step: OneStep | None = None  # the predictor of mode one-step

    @property
    def acceleration_age(self) -> float:
        """Age of the horizontal acceleration in the states of its data [s]. Raises BadModel."""
        return acceleration_age_in(self.about)

    @property
    def moving(self) -> int:
        """Number of periods of a plan in which the robot may move."""
        return self.stands or self.robot.horizon

    @property
    def first(self) -> ErrorBound:
        """The bound for one period, with which the filter compares the next measurement."""
        return self.steps[0]

    def measured_at(self, inputs: Array) -> Array:
        """Return the measured regressors [x_0] after the speeds have converged to the inputs (m,).

        Coordinates that follow no input are zero, or the recorded value that is nearest to zero: nothing is known of
        a battery without voltage.
        """
        measured = list(self.robot.regressor)
        nearest_to_zero = np.clip(0.0, *self.domain[:, : len(measured)])
        follows = np.isin(measured, self.robot.follows)
        return np.where(follows, self.robot.state_at_inputs(inputs)[measured], nearest_to_zero)

    @cached_property
    def _inputs_of(self) -> Array:
        """The map from the regressors of a plan to those of a free window."""
        return plan_regressor_map(self.robot)

    def first_regressor(self, z: Array) -> Array:
        """Return the regressor of `first` from z (..., nz): [...; input in force; first input]."""
        robot = self.robot
        if self.model_config.mode != RECURSION:
            return z if self.model_config.windows == PLAN else z @ self._inputs_of.T
        reg, m = len(robot.regressor), robot.action_dim
        missing = robot.state_dim - robot.position_dim - reg  # coordinates that are zero in the frame of now
        zeros = np.zeros((*z.shape[:-1], missing))
        return np.concatenate([zeros, z[..., : reg + 2 * m]], axis=-1)

    def tube(self) -> Tube:
        """Return the exact tube, for checks."""
        return self._stack(self.steps)

    def tube_of_windows(self) -> Tube:
        """Return the exact tube for the regressors of the windows; of free windows, they hold all N inputs."""
        return self._stack(self.steps, plans=False)

    def outer_tube(self) -> Tube:
        """Return the outer tube, with few rows in W, for the QP."""
        return self._stack([step.outer(whitening_of(step, self.basis)) for step in self.steps])

    def turning(self) -> ModelSet | None:
        """Return the model set with the predictors for plans in place; None without them."""
        if self.in_place is None:
            return None
        steps = self.in_place.steps
        if self.model_config.windows == PLAN:
            steps = tuple(step.through(plan_regressor_map(self.robot)) for step in steps)
        return replace(self, steps=steps, in_place=None)

    def _check_sizes(self) -> None:
        """Raise BadModel unless every array has the size that robot and mode require."""
        robot = self.robot
        nz = regressors(robot, self.model_config)
        one = nz if self.model_config.mode != RECURSION else robot.state_dim - robot.position_dim + 2 * robot.action_dim
        n = robot.state_dim
        if self.model_config.mode != RECURSION:
            n += robot.position_dim * sum(disc.arm > 0.0 for disc in robot.body)
        expected = [(step, n, one) for step in self.steps]
        if self.in_place is not None:
            whole = robot.regressor_dim + robot.horizon * robot.action_dim
            expected += [(step, n, whole) for step in self.in_place.steps]
        expected += [(self.chord_deviations, robot.horizon, nz), (self.stopping_distance, 1, nz)]
        for c, n, width in expected:
            g, q = c.w.size, len(c.W)
            sizes = [(n, width), (q, width), (g, q), (g, width), (g,), (n, g)]
            if [getattr(c, name).shape for name in TENSORS] != sizes:
                raise BadModel(
                    f"the model set's arrays are not those of a {robot.name} robot in mode {self.model_config.mode}"
                )
        if (self.one_step is not None) != (self.model_config.mode == ONE_STEP):
            raise BadModel(f"a model set of mode {ONE_STEP} has a predictor of one period, and no other has one")
        if self.one_step is not None:
            if self.model_config.windows != FREE or any(step.C.any() for step in self.steps):
                raise BadModel(f"a model set of mode {ONE_STEP} is of free driving and predicts by its rollout alone")
            self.one_step.check(robot)
        if self.domain.shape != (2, robot.regressor_dim) or (self.domain[0] > self.domain[1]).any():
            raise BadModel("the model set's domain is none")
        box = np.zeros((2, robot.regressor_dim + robot.action_dim)) if self.in_place is None else self.in_place.box
        if box.shape != (2, robot.regressor_dim + robot.action_dim) or (box[0] > box[1]).any():
            raise BadModel("the bounds of the model set's plans in place are none")
        if self.in_place is not None and self.model_config.mode != DIRECT:
            raise BadModel(f"a model set of mode {self.model_config.mode} has no predictors for plans in place")
        if self.basis.shape != (nz, nz) or np.linalg.matrix_rank(self.basis) < nz:
            raise BadModel("the model set's basis is none")

    def _stack(self, steps: Sequence[ErrorBound], plans: bool = True) -> Tube:
        d, more = self.robot.position_dim, extra_coordinates(self.robot)
        chord_deviations, stopping_distance = self.chord_deviations, self.stopping_distance
        if plans and self.model_config.windows == FREE:
            T = plan_regressor_map(self.robot)
            chord_deviations, stopping_distance = chord_deviations.through(T), stopping_distance.through(T)
            steps = [step.through(T) for step in steps] if self.model_config.mode != RECURSION else steps
        if self.model_config.mode != RECURSION:
            tube = stack_direct(steps, d, chord_deviations, stopping_distance, more)
            if self.one_step is None:
                return tube
            inputs_of = self._inputs_of if plans else np.eye(regressors(self.robot, self.model_config))
            return stack_rollout(tube, self.robot, self.one_step, inputs_of, more)
        how = recursion_maps(self.robot, plans or self.model_config.windows == PLAN)
        return stack_recursive(steps, how, d, chord_deviations, stopping_distance, more=more)

    @property
    def version(self) -> str:
        """Hash of the content and of its meaning: robot layout, kind of error bound, mode."""
        layout = self.layout or self.robot.layout()
        meaning = f"{layout} {self.model_config.certificate} {self.model_config.mode} "
        meaning += f"stands {self.stands} " if self.moving < self.robot.horizon else ""
        return hashlib.sha256(meaning.encode() + content(self._tensors())).hexdigest()[:12]

    def _tensors(self) -> dict[str, Array]:
        named = {"bulges": self.chord_deviations, "latch": self.stopping_distance} | {
            f"step{k}": c for k, c in enumerate(self.steps)
        }
        more = {"domain": self.domain, "basis": self.basis}
        if self.in_place is not None:
            named |= {f"{IN_PLACE}{k}": c for k, c in enumerate(self.in_place.steps)}
            more |= {BOX: self.in_place.box}
        if self.one_step is not None:
            more |= self.one_step.tensors()
        return {f"{n}.{t}": getattr(c, t) for n, c in named.items() for t in TENSORS} | more

    def encode(self) -> bytes:
        """Return the bytes of a safetensors file, with configuration, version and a checksum of both as metadata."""
        about = {
            "robot": self.robot.name,
            "layout": self.layout or self.robot.layout(),
            "recipe": asdict(self.model_config),
            "about": self.about,
            "stands": self.stands,
            "version": self.version,
        }
        if not self.layout:
            about["description"] = json.dumps(self.robot.description)  # a text: the order of its names counts
        return pack(self._tensors(), ENTRY, about | {CHECKSUM: checksum(about)})

    def save(self, path: Path | str) -> None:
        write_atomically(Path(path), self.encode())

    @staticmethod
    def decode(payload: bytes) -> ModelSet:
        """Read a model set; raise BadModel unless it is complete, finite, and of a robot that this program knows."""
        try:
            tensors, about = unpack(payload, ENTRY)
            robot = robot_in(about)
            model_config = ModelConfig(**about["recipe"])
            names = ["bulges", "latch", *(f"step{k}" for k in range(robot.horizon))]
            if BOX in tensors:
                names += [f"{IN_PLACE}{k}" for k in range(robot.horizon)]
            bounds = {name: ErrorBound(*(tensors[f"{name}.{t}"] for t in TENSORS)) for name in names}
            more = tensors["domain"], tensors["basis"], dict(about["about"])
            one_step = OneStep.of_tensors(tensors) if model_config.mode == ONE_STEP else None
            stands = int(about.get("stands", 0))
        except Exception as error:  # whatever a hostile file makes a parser raise
            made = ". If it is a data set, `brakeline certify --data FILE --use` makes a model set from it"
            hint = made if str(error).startswith("there is no 'model_set'") else ""
            raise BadModel(f"no model set: {type(error).__name__}: {error}{hint}") from error
        if not robot.accepts_layout(about.get("layout")):
            raise BadModel(f"the model set is for another layout of {robot.name}: make it again from data")
        layout = "" if about["layout"] == robot.layout() else str(about["layout"])
        if not all(t.dtype == np.float64 and np.isfinite(t).all() for t in tensors.values()):
            raise BadModel("the model set holds NaN, infinity or numbers of another type")
        if any((c.M < 0).any() or (c.kappa < 0).any() or (c.w < 0).any() for c in bounds.values()):
            raise BadModel("the model set has a negative width")
        steps = tuple(bounds[f"step{k}"] for k in range(robot.horizon))
        if not 0 <= stands <= robot.horizon:
            raise BadModel(f"a plan of {robot.horizon} periods can't have come to a stand after {stands}")
        in_place = None
        if BOX in tensors:
            in_place = InPlace(tuple(bounds[f"{IN_PLACE}{k}"] for k in range(robot.horizon)), tensors[BOX])
        chord_deviations, stopping_distance = bounds["bulges"], bounds["latch"]
        model = ModelSet(
            robot, model_config, steps, chord_deviations, stopping_distance, *more, layout, stands, in_place, one_step
        )
        model._check_sizes()
        if model.version != about.get("version"):
            raise BadModel("the model set's content is not what its version says")
        if about.get(CHECKSUM, whole := checksum(about)) != whole:
            raise BadModel("what the model set states about itself is not what its checksum says")
        return model

    @staticmethod
    def load(source: Path | str) -> ModelSet:
        """Return the model set in a file, or the one that comes with a shipped robot.

        Args:
            source: the path of a model set, or the name of a shipped robot (`"ground"`, `"quadrotor"`).

        Raises:
            BadModel: the file holds no model set, or no shipped robot has that name. The message names the source.

        >>> ModelSet.load("ground")
        ModelSet('ground', residual, direct, version 'ade8bf47fe17', at most 0.43 % of plans outside)
        """
        path = path_of_model(source)
        try:
            model = ModelSet.decode(path.read_bytes())
            refuse_shipped_name(model.robot)
            return model
        except OSError as error:
            raise BadModel(_unread(path, error)) from error
        except (BadModel, UnknownRobot) as error:
            raise BadModel(f"{path}: {error}") from error

    def __repr__(self) -> str:
        """Return one line that tells model sets apart; arrays are left out."""
        try:
            stated = f"at most {percent(float(self.about['bound_plan']))} of plans outside"
        except (KeyError, ValueError):
            stated = "no bound stated"
        kind = f"{self.model_config.certificate}, {self.model_config.mode}"
        return f"ModelSet({self.robot.name!r}, {kind}, version {self.version!r}, {stated})"


def path_of_model(source: Path | str) -> Path:
    """Return the path of a model's file; of the model set that comes with a shipped robot, if `source` is its name.

    Raises:
        BadModel: the source is a description, or neither a shipped robot's name nor a file.
    """
    path = Path(source)
    if path.suffix == ".toml":
        raise BadModel(
            f"{path} is a description: give the model set that `brakeline certify {quote(str(path))} --use` wrote, "
            "such as data/NAME/residual-one-step.safetensors; Filter.load takes the description as its second argument"
        )
    if isinstance(source, str) and source == path.name and not path.suffix:
        shipped = SHIPPED / f"{source}.model.safetensors"
        if shipped.is_file():  # a file here that is called like the robot is ./ground
            return shipped
        if not path.exists():
            names = ", ".join(sorted(p.name.partition(".")[0] for p in SHIPPED.glob("*.model.safetensors")))
            raise BadModel(f"no model set comes with {source!r}; there are: {names}, or give the path of a file")
    return path


def _unread(path: Path, error: OSError) -> str:
    """Return why a path gives no model set, and what to give instead."""
    if path.is_dir():
        inside = ", ".join(sorted(one.name for one in path.glob("*.safetensors"))) or "no .safetensors"
        return f"{path} is a folder: give the model set in it (there is {inside})"
    if isinstance(error, FileNotFoundError):
        return f"there is no file {path}: `brakeline certify FILE.toml --use` writes a model set and prints its path"
    return f"{path}: {error}"


def checksum(about: dict[str, Any]) -> str:
    """Return the hash of a model set's metadata. It shows damage to the stated bound, which no version covers."""
    stated = {name: value for name, value in about.items() if name != CHECKSUM}
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


def robot_in(about: dict[str, Any]) -> Robot:
    """Return the robot of a model set, from the description that it carries or, in old files, by its name.

    Raises:
        UnknownRobot: the description is missing or belongs to another robot.
    """
    name = str(about["robot"])
    if "description" not in about:
        if about.get("layout") != FORMER_LAYOUTS.get(name):
            raise UnknownRobot(f"{name}: neither a description nor the layout of a robot known before there were any")
        return robot_named(name)
    robot = robot_from_description(parse_json(about["description"]), "the model set's robot")
    robot = robot.in_real_time() if name.endswith(REAL_TIME_SUFFIX) else robot
    if robot.name != name:
        raise UnknownRobot(f"the model set is of {name!r}, its description of {robot.name!r}")
    return robot


def regressors(robot: Robot, model_config: ModelConfig) -> int:
    """Return the length of the regressors of the configured windows."""
    chosen = robot.free_steps if model_config.windows == PLAN else robot.horizon
    return robot.regressor_dim + chosen * robot.action_dim


def extra_coordinates(robot: Robot) -> tuple[int, ...]:
    """Return the predicted coordinates, besides the position, that limits and further discs of the body need."""
    d, n = robot.position_dim, robot.state_dim
    limited = {i for limit in robot.limits for i, weight in enumerate(limit.weights) if weight and i >= d}
    discs = d * sum(disc.arm > 0.0 for disc in robot.body)
    return (*sorted(limited), *range(n, n + discs))


def deciding_coordinates(robot: Robot) -> NDArray[np.bool_]:
    """Return which coordinates (n,) of a state decide what is verified.

    These are the position, the coordinates with a limit, and the heading of a body with discs beside the position.
    """
    decide, extra = np.zeros(robot.state_dim, dtype=bool), extra_coordinates(robot)
    decide[: robot.position_dim] = True
    decide[[i for i in extra if i < robot.state_dim]] = True
    if robot.heading is not None:
        decide[robot.heading] |= any(i >= robot.state_dim for i in extra)
    return decide


def scored_coordinates(robot: Robot) -> tuple[int, ...]:
    """Return the coordinates that a plan must predict after every period: the position, and `extra_coordinates`.

    The other predicted coordinates count after one period only.
    """
    return (*range(robot.position_dim), *extra_coordinates(robot))


def whitening_of(step: ErrorBound, basis: Array) -> Array:
    """Return the basis B for a step; regressors of the recursion have more coordinates than z (the heading).

    Their basis comes from the step's rows W, those of Z⁺, whose second moment is the inverse of the regressors'.
    """
    if step.C.shape[1] == len(basis):
        return basis
    inverse = step.W.T @ step.W
    used = np.diag(inverse) > 0.0
    own = np.eye(len(inverse))
    own[np.ix_(used, used)] = np.linalg.cholesky(inverse[np.ix_(used, used)]).T
    return own
