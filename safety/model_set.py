"""A model set: everything the filter knows about a robot, made from recorded data, versioned by its content."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from messaging.files import write_whole
from messaging.robots import Robot, UnknownRobot, robot_named
from messaging.shapes import rotate
from safety.certificates import (
    KINDS,
    MATRIX_ZONOTOPE,
    RESIDUAL,
    SET_MEMBERSHIP,
    Certificate,
    envelope,
    least_squares,
    matrix_zonotope,
    residual,
    set_membership,
    whitening,
)
from safety.dataset import BadData, Dataset, Windows, quality, windows
from safety.tensors import content, pack, unpack
from safety.tube import Tube, recursion_of, stack_direct, stack_recursive

Array = NDArray[np.float64]

DIRECT, RECURSION = "direct", "recursion"
MODES = (DIRECT, RECURSION)
MOST_ATOMS = 120_000  # of a matrix zonotope, over the horizon: the exact check looks at every one
ENTRY = "model_set"
TENSORS = ("C", "W", "M", "kappa", "w", "generators")


class BadModel(ValueError):
    """A model set that must not be used; the message says why."""


@dataclass(frozen=True)
class Recipe:
    """How a model set is made from a data set."""

    certificate: str = RESIDUAL
    mode: str = DIRECT
    inflation: float = 1.15  # of every envelope: what the next data may exceed the recorded ones by
    seed: int = 0  # of the recursion's heading offsets

    def __post_init__(self) -> None:
        if self.certificate not in KINDS:
            raise ValueError(f"no certificate is called {self.certificate!r}; there are: {', '.join(KINDS)}")
        if self.mode not in MODES:
            raise ValueError(f"no mode is called {self.mode!r}; there are: {', '.join(MODES)}")
        if not 1.0 <= self.inflation < np.inf:
            raise ValueError(f"an envelope scaled by {self.inflation} bounds nothing")


@dataclass(frozen=True)
class ModelSet:
    """steps[k]: direct, what k+1 periods do to z; recursion, what period k does to z_k. bulges: one row a step."""

    robot: Robot
    recipe: Recipe
    steps: tuple[Certificate, ...]
    bulges: Certificate
    latch: Certificate
    domain: Array  # (2, regressor_dim): smallest and largest recorded [x_0; input in force]
    basis: Array  # (nz, nz): coordinates in which the recorded z are white
    about: dict[str, str]

    @property
    def first(self) -> Certificate:
        """What one period does: for comparing the next measurement with its prediction."""
        return self.steps[0]

    def first_regressor(self, z: Array) -> Array:
        """The regressor of `first` from z (..., nz): [.. ; input in force; first input]."""
        robot = self.robot
        if self.recipe.mode == DIRECT:
            return z
        reg, m = len(robot.regressor), robot.action_dim
        missing = robot.state_dim - robot.position_dim - reg  # coordinates that are zero in the frame of now
        zeros = np.zeros((*z.shape[:-1], missing))
        return np.concatenate([zeros, z[..., : reg + 2 * m]], axis=-1)

    def tube(self) -> Tube:
        """The stacked tube with every generator as it is: for checks."""
        return self._stack(self.steps)

    def outer_tube(self) -> Tube:
        """One that contains it and has few atoms: for the QP."""
        return self._stack([step.outer(whitening_of(step, self.basis)) for step in self.steps])

    def _check_sizes(self) -> None:
        """Raises BadModel unless every array has the size that robot and mode give it."""
        robot = self.robot
        nz = robot.regressor_dim + robot.free_steps * robot.action_dim
        one = nz if self.recipe.mode == DIRECT else robot.state_dim - robot.position_dim + 2 * robot.action_dim
        expected = [(step, robot.state_dim, one) for step in self.steps]
        expected += [(self.bulges, robot.horizon, nz), (self.latch, 1, nz)]
        for c, n, width in expected:
            g, q = c.w.size, len(c.W)
            sizes = [(n, width), (q, width), (g, q), (g, width), (g,), (n, g)]
            if [getattr(c, name).shape for name in TENSORS] != sizes:
                raise BadModel(
                    f"the model set's arrays are not those of a {robot.name} robot in mode {self.recipe.mode}"
                )
        if self.domain.shape != (2, robot.regressor_dim) or (self.domain[0] > self.domain[1]).any():
            raise BadModel("the model set's domain is none")
        if self.basis.shape != (nz, nz) or np.linalg.matrix_rank(self.basis) < nz:
            raise BadModel("the model set's basis is none")

    def _stack(self, steps: list[Certificate] | tuple[Certificate, ...]) -> Tube:
        if self.recipe.mode == DIRECT:
            return stack_direct(steps, self.robot.position_dim, self.bulges, self.latch)
        return stack_recursive(steps, recursion_of(self.robot), self.robot.position_dim, self.bulges, self.latch)

    @property
    def version(self) -> str:
        """Hash of the content and of what it means, so that one name can't mean two models."""
        meaning = f"{self.robot.layout()} {self.recipe.certificate} {self.recipe.mode} "
        return hashlib.sha256(meaning.encode() + content(self._tensors())).hexdigest()[:12]

    def _tensors(self) -> dict[str, Array]:
        named = {"bulges": self.bulges, "latch": self.latch} | {f"step{k}": c for k, c in enumerate(self.steps)}
        tensors = {f"{n}.{t}": getattr(c, t) for n, c in named.items() for t in TENSORS}
        return tensors | {"domain": self.domain, "basis": self.basis}

    def encode(self) -> bytes:
        """Bytes of a safetensors file, with the recipe as its metadata."""
        about = {
            "robot": self.robot.name,
            "layout": self.robot.layout(),
            "recipe": asdict(self.recipe),
            "about": self.about,
            "version": self.version,
        }
        return pack(self._tensors(), ENTRY, about)

    def save(self, path: Path) -> None:
        write_whole(path, self.encode())

    @staticmethod
    def decode(payload: bytes) -> ModelSet:
        """Raises BadModel unless the bytes are a complete, finite model set of a robot that this program knows."""
        try:
            tensors, about = unpack(payload, ENTRY)
            robot = robot_named(about["robot"])
            recipe = Recipe(**about["recipe"])
            certificates = {
                name: Certificate(*(tensors[f"{name}.{t}"] for t in TENSORS))
                for name in ("bulges", "latch", *(f"step{k}" for k in range(robot.horizon)))
            }
            more = tensors["domain"], tensors["basis"], dict(about["about"])
        except (KeyError, TypeError, ValueError, UnknownRobot) as error:
            raise BadModel(f"no model set: {error!r}") from error
        if about.get("layout") != robot.layout():
            raise BadModel(f"the model set is for another layout of {robot.name}: make it again from data")
        if not all(t.dtype == np.float64 and np.isfinite(t).all() for t in tensors.values()):
            raise BadModel("the model set holds NaN, infinity or numbers of another type")
        if any((c.M < 0).any() or (c.kappa < 0).any() or (c.w < 0).any() for c in certificates.values()):
            raise BadModel("the model set has a negative width")
        steps = tuple(certificates[f"step{k}"] for k in range(robot.horizon))
        model = ModelSet(robot, recipe, steps, certificates["bulges"], certificates["latch"], *more)
        model._check_sizes()
        if model.version != about.get("version"):
            raise BadModel("the model set's content is not what its version says")
        return model

    @staticmethod
    def load(path: Path) -> ModelSet:
        """Raises BadModel, naming the file."""
        try:
            return ModelSet.decode(path.read_bytes())
        except OSError as error:
            raise BadModel(f"{path}: {error}") from error
        except BadModel as error:
            raise BadModel(f"{path}: {error}") from error


def whitening_of(step: Certificate, basis: Array) -> Array:
    """The basis for a step whose regressor may have more coordinates than z (the recursion's has the heading)."""
    if step.C.shape[1] == len(basis):
        return basis
    return np.eye(step.C.shape[1]) if not len(step.W) else whitening_from(step.W)


def whitening_from(pseudo: Array) -> Array:
    """Rows of Z⁺ have the inverse second moment of the regressors: its root whitens. Unused coordinates stay."""
    inverse = pseudo.T @ pseudo
    used = np.diag(inverse) > 0.0
    basis = np.eye(len(inverse))
    basis[np.ix_(used, used)] = np.linalg.cholesky(inverse[np.ix_(used, used)]).T
    return basis


def make(data: Dataset, recipe: Recipe) -> ModelSet:
    """A model set from two parts of the data: one fits C, the other bounds what is left (held-out data: certify).

    Raises:
        BadData: a check failed; CertificateError: the data do not support the certificate.
    """
    robot = data.robot
    fit, bound = data.split((0.5, 0.5))
    steps, bulges = [], []
    horizon = robot.horizon
    for k in range(1, horizon + 1):
        seen, rest = windows(fit, k), windows(bound, k)
        for part in (seen, rest):
            quality(_used(robot, part.z, k), f"windows of {k} periods")
        every = windows(data, k)  # no predictor is fitted to bulges: both parts may bound them
        bulges.append(envelope(np.abs(every.z), every.bulge, recipe.inflation))
        if recipe.mode == DIRECT:
            steps.append(
                _certificate(seen.z, seen.y, rest.z, rest.y, recipe, _columns(robot, k), MOST_ATOMS // horizon)
            )
        else:
            steps.append(_recursive_step(robot, windows(fit, 1), windows(bound, 1), k - 1, recipe))
    whole = windows(data, horizon)
    still = ~np.isnan(whole.latch)
    if not still.any():
        raise BadData("no plan's stop was recorded: let the robot stand after braking")
    latch = envelope(np.abs(whole.z[still]), whole.latch[still], recipe.inflation)
    nz = whole.z.shape[1]
    known = windows(data, 1).z[:, : robot.regressor_dim]
    domain = np.stack([known.min(0), known.max(0)])
    about = data.about | {"data": data.digest(), "periods": str(data.periods)}
    return ModelSet(
        robot, recipe, tuple(steps), _scalar(bulges, nz), _scalar([latch], nz), domain, whitening(whole.z), about
    )


def _columns(robot: Robot, k: int) -> NDArray[np.bool_]:
    """Which coordinates of z can matter after k periods: later free inputs can't."""
    used = np.ones(robot.regressor_dim + robot.free_steps * robot.action_dim, dtype=bool)
    used[robot.regressor_dim + min(k, robot.free_steps) * robot.action_dim :] = False
    return used


def _used(robot: Robot, z: Array, k: int) -> Array:
    return z[:, _columns(robot, k)]


def _scalar(bounds: list[tuple[Array, float]], nz: int) -> Certificate:
    """Bounds of lengths as a certificate: nothing but κ and w."""
    n = len(bounds)
    kappa, w = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    return Certificate(np.zeros((n, nz)), np.zeros((0, nz)), np.zeros((n, 0)), kappa, w, np.eye(n))


def _certificate(
    z: Array, y: Array, z_bound: Array, y_bound: Array, recipe: Recipe, columns: NDArray[np.bool_], most_atoms: int
) -> Certificate:
    """The recipe's certificate: the noise of all three is the residual's envelope, they differ in trusting C.

    A matrix zonotope has an atom a sample and more samples do not shrink it: it takes no more than `most_atoms`,
    evenly over the data.
    """
    trusted = residual(z_bound, y_bound, least_squares(z, y, columns), recipe.inflation)
    if recipe.certificate == RESIDUAL:
        return trusted
    if recipe.certificate == MATRIX_ZONOTOPE and len(z_bound) > most_atoms:
        chosen = np.linspace(0, len(z_bound) - 1, most_atoms).astype(int)
        z_bound, y_bound = z_bound[chosen], y_bound[chosen]
    z_in = z_bound[:, columns]
    sizes = (np.abs(z_bound) @ trusted.kappa.T + trusted.w).T
    kappa, w = trusted.kappa, trusted.w
    if recipe.certificate == SET_MEMBERSHIP:
        small = set_membership(z_in, y_bound, sizes, kappa[:, columns], w)
    else:
        assert recipe.certificate == MATRIX_ZONOTOPE
        small = matrix_zonotope(z_in, y_bound, np.eye(y.shape[1]), sizes, kappa[:, columns], w)
    C, W = np.zeros_like(trusted.C), np.zeros((len(small.W), len(columns)))
    C[:, columns], W[:, columns] = small.C, small.W
    return Certificate(C, W, small.M, kappa, w, small.generators)


def _recursive_step(robot: Robot, fit: Windows, bound: Windows, k: int, recipe: Recipe) -> Certificate:
    """Period k of the recursion: z_k = [heading, ...; u_prev; u] from one-period windows turned by a random offset.

    After k periods the robot may have turned by k ω_max dt against the frame of now, as measured a bit more; without
    offsets the heading would be zero in every window and the data would say nothing about it.
    """
    rng = np.random.default_rng((recipe.seed, k))
    turned = [_turned(robot, w, k, rng) for w in (fit, bound)]
    columns = np.abs(turned[0][0]).max(0) > 0.0
    return _certificate(*turned[0], *turned[1], recipe, columns, MOST_ATOMS // robot.horizon)


def _turned(robot: Robot, w: Windows, k: int, rng: np.random.Generator) -> tuple[Array, Array]:
    reg, m = len(robot.regressor), robot.action_dim
    values, inputs = w.z[:, :reg], w.z[:, reg : reg + 2 * m]
    y = w.y.copy()
    between = robot.state_dim - robot.position_dim - reg
    lead = np.zeros((len(y), between))
    if robot.heading is not None:
        fastest = robot.high()[-1] * robot.period * k + 2.0 * robot.measurement_bound[robot.heading]
        offset = rng.uniform(-fastest, fastest, len(y)) if k else np.zeros(len(y))
        y[:, : robot.position_dim] = rotate(y[:, : robot.position_dim], offset)
        y[:, robot.heading] += offset
        lead[:, 0] = offset
    return np.hstack([lead, values, inputs]), y


__all__ = ["DIRECT", "MODES", "RECURSION", "BadData", "BadModel", "ModelSet", "Recipe", "make"]
