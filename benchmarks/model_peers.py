"""Compare models from the same recorded minutes: one learned period, the linear forms, sets of consistent models.

    python -m benchmarks model-peers

For a differential drive (examples/own_log, 4 and 15 minutes) and the shipped ground robot, each row has the half-width
of the last set of a plan that brakes from full speed and of one that stands, the share of new plans whose positions
leave their sets with its exact 99 % interval, and the processor times of the fit and of one tube.

Every form predicts measured positions from measured states over the same plans. The peers get the features that the
one-step form chose and its geometry of poses. Their noise bound is the envelope of the out-of-fold errors of one
period, scaled to the same quantile. ZRLS forgets nothing (λ = 1, the narrowest here).
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from types import ModuleType

import numpy as np

from benchmarks.consistent_models import ConsistentModels, LeastSquaresZonotope, Models, ModelTubes, Noise
from benchmarks.timing import Words
from brakeline.deploy.data import collect
from brakeline.deploy.data.certification import certify_supported
from brakeline.deploy.data.importer import import_sources
from brakeline.deploy.data.simulated_recording import load_or_record
from brakeline.logs.proportion_intervals import clopper_pearson
from brakeline.messaging.robot import Array, Robot, robot_named
from brakeline.messaging.stated_share import CONFIDENCE
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.calibration_samples import samples_of
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_config import DIRECT, FREE, MATRIX_ZONOTOPE, ONE_STEP, PLAN, ModelConfig
from brakeline.safety.model.model_set import RECURSION, ModelSet
from brakeline.safety.model.one_step import features_for
from brakeline.safety.model.one_step_fitting import choose
from brakeline.safety.model.one_step_regression import Regression
from brakeline.safety.model.windows import displacement, non_overlapping, plan_regressor_map, windows
from brakeline.sim.sim_conditions import Conditions

Tubes = Callable[[Array], tuple[Array, Array]]  # windows with all inputs (T, r + m + N·m) -> centres, half-widths

OWN_LOG = Path(__file__).parents[1] / "examples" / "own_log"
MINUTES = (4.0, 15.0)
FRESH_RUNS, FRESH_TRAJECTORIES = 60, 60  # runs of a minute; trajectories of 300 periods
SEED = 1
CHUNK = 64  # windows at once: an exact matrix zonotope has thousands of rows
TIMED_S = 0.2  # processor time of the tubes that are timed


@dataclass(frozen=True)
class Recording:
    """Recorded driving, and plans of new driving that do not overlap: regressors with all inputs, positions."""

    name: str
    data: Dataset
    kind: str  # of the windows
    z: Array
    after: Array  # (T, N, 2)

    @staticmethod
    def of(name: str, data: Dataset, fresh: Dataset, kind: str) -> Recording:
        """Take the windows of `kind` from new driving."""
        robot, N = data.robot, data.robot.horizon
        plans = non_overlapping(windows(fresh, N, kind), N)
        z = plans.z if kind == FREE else plans.z @ plan_regressor_map(robot).T
        whole = np.stack([fresh.trajectories[i].states[j : j + N + 1] for i, j in plans.start])
        after = np.stack([displacement(robot, whole[:, 0], whole[:, k]) for k in range(1, N + 1)], axis=1)
        return Recording(name, data, kind, z, after[..., : robot.position_dim])


def own_log() -> ModuleType:
    """Return examples/own_log/table.py as a module: its simulators judge, and its drivers drive."""
    if str(OWN_LOG) not in sys.path:
        sys.path.insert(0, str(OWN_LOG))
    return importlib.import_module("table")


def driven(minutes: float, seed: int, runs: int = 1, name: str = "diff") -> Dataset:
    """Return a drive of a robot of examples/own_log, as `brakeline import` reads it."""
    with tempfile.TemporaryDirectory() as folder:
        log = own_log().record(name, minutes, seed, Path(folder) / "drive.csv", runs)
        return import_sources([log], robot_named(str(OWN_LOG / f"{name}.toml"))).data


def recordings() -> Iterator[Recording]:
    """Yield the recordings of the two robots."""
    hour = driven(FRESH_RUNS, SEED + 1000, FRESH_RUNS)
    for minutes in MINUTES:
        yield Recording.of(f"diff, {minutes:g} min", driven(minutes, SEED), hour, FREE)
    ground = robot_with_task("ground")
    data = load_or_record(ground)
    fresh = list(collect.record(ground, FRESH_TRAJECTORIES, SEED, Conditions()))
    yield Recording.of("ground, 200 min", data, replace(data, trajectories=tuple(fresh)), PLAN)


def tubes_of(model: ModelSet) -> Tubes:
    """Return the tubes of one of our model sets."""
    tube, robot, back = model.tube_of_windows(), model.robot, None
    if model.model_config.windows == PLAN:
        back = np.linalg.pinv(plan_regressor_map(robot)).T

    def tubes(z: Array) -> tuple[Array, Array]:
        regressors = z if back is None else z @ back
        sizes = tube.magnitudes(regressors)[:, : tube.generators]
        half = np.einsum("tl,ndl->tnd", sizes, np.abs(tube.directions))
        if model.one_step is not None:
            half = half * model.one_step.stretches(robot, regressors)[..., None]
        return tube.outputs(regressors)[0], half

    return tubes


def fastest(robot: Robot) -> Array:
    """Return the inputs (m,) of full speed straight on."""
    return np.where(robot.translates, robot.high(), 0.0)


def braking(robot: Robot, inputs: Array) -> Array:
    """Return the regressors (nz,) of a plan that brakes from constant inputs (m,)."""
    state = robot.state_at_inputs(inputs)[list(robot.regressor)]
    return np.concatenate([state, inputs, np.tile(inputs, robot.free_steps)])


def processor_s(call: Callable[[], object]) -> float:
    """Return the mean processor time of a call; other processes on this machine do not count."""
    call()
    count, started = 0, process_time()
    while process_time() < started + TIMED_S:
        call()
        count += 1
    return (process_time() - started) / count


def row(recording: Recording, tubes: Tubes, fitted_s: float, one: Callable[[], object]) -> dict[str, float | str]:
    """Return the figures of one form. one: computes a single tube."""
    robot, z = recording.data.robot, recording.z
    chunks = np.array_split(np.arange(len(z)), len(z) // CHUNK + 1)
    center, half = (np.concatenate(part) for part in zip(*(tubes(z[chunk]) for chunk in chunks), strict=True))
    outside = int((~(np.abs(recording.after - center) <= half)).any((1, 2)).sum())
    low, high = clopper_pearson(outside, len(z), CONFIDENCE) or (0.0, 1.0)
    plans = np.stack([braking(robot, inputs) for inputs in (fastest(robot), 0.0 * robot.high())])
    widths = 1e3 * tubes(plans @ plan_regressor_map(robot).T)[1][:, -1].max(1)
    return {
        "full speed mm": float(widths[0]),
        "at rest mm": float(widths[1]),
        "plans": float(len(z)),
        "outside %": f"{1e2 * outside / len(z):.3g} ({1e2 * low:.2g} to {1e2 * high:.2g})",
        "fit s": fitted_s,
        "tube us": 1e6 * processor_s(one),
    }


def ours(recording: Recording, config: ModelConfig) -> dict[str, float | str]:
    """Return the row of one of our forms."""
    started = process_time()
    model, _, _ = certify_supported(recording.data, config)
    fitted_s = process_time() - started
    tube, z = model.tube(), braking(model.robot, fastest(model.robot))

    def one() -> None:
        exact = tube.at(z)
        exact.centers(z), exact.half_widths(z)

    return row(recording, tubes_of(model), fitted_s, one)


def peer(recording: Recording, fit: Callable[[Array, Array, Array], Models]) -> dict[str, float | str]:
    """Return the row of a set of models, with monomials that are selected as for the one-step form."""
    robot = recording.data.robot
    s = samples_of(recording.data)
    chosen = choose(robot, s)[0].candidate
    all_features = features_for(robot, s.v, chosen.degree, chosen.lags)
    monomials = np.flatnonzero((all_features.terms <= s.v.shape[1]).all(1))  # the peers' boxes have no others
    features = Regression(robot, all_features.subset(monomials), s).fit(chosen).features
    started = process_time()
    noise, phi = Noise.of(features, s), features(s.v)
    tubes = ModelTubes(robot, features, fit(phi, s.y, noise.sizes(s.v)), noise)
    fitted_s = process_time() - started
    window = (plan_regressor_map(robot) @ braking(robot, fastest(robot)))[None]
    return row(recording, tubes, fitted_s, lambda: tubes(window))


PEERS: dict[str, Callable[[Array, Array, Array], Models]] = {
    "constrained matrix zonotope": ConsistentModels.fit,
    "zonotopic recursive least squares": LeastSquaresZonotope.fit,
}
OURS = {
    "ours, one-step": ModelConfig(mode=ONE_STEP),
    "ours, direct": ModelConfig(mode=DIRECT),
    "matrix zonotope, recursion (the paper)": ModelConfig(MATRIX_ZONOTOPE, RECURSION),
}


class Rows(dict[str, dict[str, float | str]]):
    """Rows that are printed as they come: all of them take a quarter of an hour."""

    def __setitem__(self, name: str, figures: dict[str, float | str]) -> None:
        print(f"{name}: {figures}", file=sys.stderr, flush=True)
        super().__setitem__(name, figures)


def run() -> Words:
    """Return a row for each recording and form."""
    figures = Rows()
    for recording in recordings():
        for name, config in OURS.items():
            minutes = recording.kind == FREE  # as `brakeline certify` treats imported logs
            figures[f"{recording.name}: {name}"] = ours(recording, config.of_minutes() if minutes else config)
        for name, fit in PEERS.items():
            figures[f"{recording.name}: {name}"] = peer(recording, fit)
    return figures
