"""Committed plans as arrays decide, widen and brake as one `BackupPlan` for each robot does."""

import math
from copy import deepcopy
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from brakeline.errors import BadRequest, Mismatch
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan, correction_penalty
from brakeline.safety.filter.batch.decision_arrays import KINDS, DecisionArrays
from brakeline.safety.filter.batch.obstacle_arrays import ObstacleArrays
from brakeline.safety.filter.batch.plan_batch import BackupPlanBatch, correction_penalties
from brakeline.safety.filter.batch.row_by_row import RowByRow
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE
from brakeline.safety.filter.widening import WINDOWS, Widening
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.safety.service.in_process import InProcess
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.navigation_env import NavigationEnv
from tests.safety.test_batch import one_step

GROUND = robot_with_task("ground")
SAFETY = Filter.load("ground")


def near(info: dict[str, Any], row: int) -> list[Obstacle]:
    arena, position = info["arena"][row], info["state"][row][:2]
    return [arena.obstacles[i] for i in np.flatnonzero(arena.shapes.distance(position) <= GROUND.sight)]


def test_a_batch_decides_as_single_plans_do_over_whole_episodes() -> None:
    """The inputs differ by less than 1e-6; the status of each plan and the widening are the same.

    One of the robots is measured a centimetre off every seventh period, so it leaves its sets.
    """
    size, rng = 4, np.random.default_rng(0)
    env, singles = BatchNavigationEnv(GROUND, size, "dense"), [InProcess(SAFETY) for _ in range(size)]
    _, infos = env.reset(seed=0)
    plans = BackupPlanBatch(SAFETY, size)
    status = np.array(["", SAFETY.version, UNVERIFIED])
    for period in range(60):
        actions = np.column_stack([np.full(size, 0.25), rng.uniform(-0.5, 0.5, size)])
        infos["state"][1, 0] += 0.01 if period % 7 == 6 else 0.0
        before = plans.input_in_force
        outcome = plans.decide(infos["state"], actions, ObstacleArrays(**infos["obstacles"]))
        penalties = correction_penalties(GROUND, actions, before, outcome.inputs, 1.0)
        for row, single in enumerate(singles):
            single.decide(infos["state"][row], actions[row], near(infos, row), known_free=True)
            plan = single.backup_plan
            assert np.abs(outcome.inputs[row] - plan.next_input).max() < 1e-6
            assert status[plans._status[row]] == plan.model
            factors = plans.widening[row], plans.state_widening[row]
            assert factors == pytest.approx(plan.widening.factors, abs=1e-6)
            penalty = correction_penalty(GROUND, actions[row], before[row], outcome.inputs[row], 1.0)
            assert penalties[row] == pytest.approx(penalty, abs=1e-12)
        _, _, terminated, truncated, infos = env.step(outcome.inputs)
        ended = terminated | truncated
        plans.reset(ended)
        for row in np.flatnonzero(ended):
            singles[row].backup_plan.reset()
    assert plans.widening[1] > 1.5 and plans.widening[[0, 2, 3]].max() < 1.3
    plans.reset(np.arange(size) == 1)
    assert plans.widening[1] > 1.5, "it is the same robot in another episode"
    plans.independent = True
    plans.reset(np.arange(size) == 1)
    assert plans.widening[1] == 1.0
    env.close()


def test_a_batch_leaves_out_as_many_scores_as_a_single_plan() -> None:
    plans, singles, rng = BackupPlanBatch(SAFETY, 3), [Widening(GROUND) for _ in range(3)], np.random.default_rng(1)
    plans._outside_share = 0.005
    for scores in rng.exponential(1.0, (WINDOWS + 50, 3)):
        of_plans = 0.7 * scores
        plans._judge(np.ones(3, dtype=bool), of_plans, scores)
        for single, of_plan, score in zip(singles, of_plans.tolist(), scores.tolist(), strict=True):
            single.judge(score, 0.005, of_plan)
        factors = zip(plans.widening.tolist(), plans.state_widening.tolist(), strict=True)
        assert list(factors) == [single.factors for single in singles]


class Broken:
    """A filter that writes a value into a place of each batch of plans, or that fails as a whole."""

    def __init__(self, place: Any, value: float = math.nan) -> None:
        self.robot, self.version, self._place, self._value = SAFETY.robot, SAFETY.version, place, value

    def decide_batch(self, requests: Any) -> DecisionArrays:
        if self._place is None:
            raise BadRequest("state", "row 0: not finite")
        answers = SAFETY.decide_batch(requests)
        answers.plan[self._place] = self._value
        return answers


BEYOND_BOUNDS, ENDLESS, NOT_FINITE, FAILING = Broken((0, 0), 9.0), Broken((0, -1), 0.2), Broken(0), Broken(None)


@pytest.mark.parametrize("broken", [BEYOND_BOUNDS, ENDLESS, NOT_FINITE, FAILING])
def test_a_row_without_a_valid_decision_brakes_along_its_committed_plan(broken: Broken) -> None:
    """As `BackupPlan.fallback`: the first row brakes; the second goes on, unless the filter failed as a whole."""
    plans, single = BackupPlanBatch(SAFETY, 2), InProcess(SAFETY)
    free = ObstacleArrays.of([Shapes.of([], 2)] * 2)
    states = np.tile([0.0, 0.0, 0.0, 0.0, 0.0], (2, 1))
    actions = np.tile([0.2, 0.1], (2, 1))
    assert np.allclose(plans.decide(states, actions, free).inputs, actions)
    single.decide(states[0], actions[0], [], known_free=True)
    states[:, 0], states[:, 3] = 0.03, 0.19
    plans.safety = broken  # type: ignore[assignment]
    outcome = plans.decide(states, actions, free)
    single.backup_plan.measured(states[0])
    assert np.allclose(outcome.inputs[0], single.backup_plan.fallback())
    assert outcome.decided.tolist() == [False, broken is not FAILING] and outcome.failure
    if outcome.answers is not None:
        assert outcome.answers.verified.tolist() == [False, True]
        assert [outcome.answers.row(row).kind for row in range(2)] == [FAILSAFE, ALLOWED]
    assert np.allclose(outcome.inputs[1], actions[1]) == (broken is not FAILING)
    assert np.array(["", SAFETY.version, UNVERIFIED])[plans._status[0]] == single.backup_plan.model


def test_a_robot_that_leaves_its_tube_while_nobody_decides_has_no_verified_plan() -> None:
    """As a single plan: the first robot keeps to its tube, and the second leaves it after a period without decision."""
    plans, singles = BackupPlanBatch(SAFETY, 2), [InProcess(SAFETY) for _ in range(2)]
    names, free = np.array(["", SAFETY.version, UNVERIFIED]), ObstacleArrays.of([Shapes.of([], 2)] * 2)
    states, actions = np.zeros((2, 5)), np.tile([0.2, 0.0], (2, 1))
    plans.decide(states, actions, free)
    for row, single in enumerate(singles):
        single.decide(states[row], actions[row], known_free=True)
    plans.safety = FAILING  # type: ignore[assignment]
    states[:] = plans.predicted.center
    for _ in range(2):
        plans.decide(states, actions, free)
        for row, single in enumerate(singles):
            single.backup_plan.measured(states[row])
            single.fallback()
        assert names[plans._status].tolist() == [single.backup_plan.model for single in singles]
        states[:, :2] = plans._tube[0][:, 0]
        states[1, 0] += 0.5
    assert names[plans._status].tolist() == [SAFETY.version, UNVERIFIED]


def test_a_request_after_a_lost_decision_states_whether_the_robot_is_in_its_tube() -> None:
    plans, free = BackupPlanBatch(SAFETY, 3), ObstacleArrays.of([Shapes.of([], 2)] * 3)
    states, actions, requested = np.zeros((3, 5)), np.tile([0.2, 0.0], (3, 1)), []
    plans.decide(states, actions, free)
    plans.safety = FAILING  # type: ignore[assignment]
    states[:] = plans.predicted.center
    states[2] = np.nan
    plans.decide(states, actions, free)
    plans.safety = Broken((0, 0, 0), 0.2)  # type: ignore[assignment]
    decide = plans.safety.decide_batch
    plans.safety.decide_batch = lambda requests: requested.append(requests.model) or decide(requests)  # type: ignore
    states[:, :2] = plans._tube[0][:, 0]
    states[2, 2:] = states[0, 2:]
    states[1, 0] += 0.5
    plans.decide(states, actions, free)
    assert requested == [[SAFETY.version, UNVERIFIED, SAFETY.version]]


@pytest.mark.parametrize("missing", [1, 2])  # a plan has 3 periods
def test_a_robot_outside_its_tube_after_missing_decisions_has_no_verified_plan(missing: int) -> None:
    """As `BackupPlan`. Nothing compared its positions: wherever the robot was, its plan counted as verified."""
    plans, single, free = BackupPlanBatch(SAFETY, 3), InProcess(SAFETY), ObstacleArrays.of([Shapes.of([], 2)] * 3)
    state, go, asked = np.zeros(5), np.array([0.25, 0.0]), []
    plans.decide(np.tile(state, (3, 1)), np.tile(go, (3, 1)), free)
    answer = single.decide(state, go, known_free=True)
    plans.safety = FAILING  # type: ignore[assignment]
    for k in range(missing):
        state = answer.predicted.center if k == 0 else np.append(answer.tube_center[k], np.zeros(3))
        assert not plans.decide(np.tile(state, (3, 1)), np.tile(go, (3, 1)), free).decided.any()
        single.request(single.backup_plan, state, go, known_free=True)
        single.fallback()
    plans.safety = Broken(None)  # type: ignore[assignment]
    plans.safety.decide_batch = lambda requests: asked.append(requests) or SAFETY.decide_batch(requests)  # type: ignore
    (center, *_), (half, *_) = answer.tube_center[missing], answer.tube_half_width[missing]
    states = np.tile(state, (3, 1))
    states[:, 0] = center + np.array([0.9, 1.1, np.nan]) * half
    plans.decide(states, np.tile(go, (3, 1)), free)
    models = [single.request(deepcopy(single.backup_plan), one, go, known_free=True).model for one in states]
    assert asked[0].model == models == [SAFETY.version, UNVERIFIED, SAFETY.version]


@pytest.mark.parametrize("safety", [lambda: SAFETY, one_step], ids=["periods", "windows"])
def test_a_proposal_that_is_not_finite_is_decided_and_scored_as_by_a_single_plan(safety: Any) -> None:
    """The robot leaves its set in the very period of that proposal, so the score of the period widens its sets."""
    plans, single = BackupPlanBatch(safety(), 2), InProcess(safety(), accept_bound=1.0)
    free = ObstacleArrays.of([Shapes.of([], 2)] * 2)
    status, states, N = np.array(["", single.method.version, UNVERIFIED]), np.zeros((2, 5)), single.robot.horizon
    for period in range(3 * N):
        actions = np.zeros((2, 2))
        if period == 2 * N:
            actions[0, 1], states[0, 3] = np.nan, 0.1
        outcome = plans.decide(states, actions, free)
        answer = single.decide(states[0], actions[0], known_free=True)
        assert outcome.decided.all() and not outcome.failure and outcome.answers is not None
        assert outcome.answers.row(0).kind == answer.kind == (FAILSAFE if period == 2 * N else ALLOWED)
        assert np.allclose(outcome.inputs[0], answer.action)
        assert status[plans._status[0]] == single.backup_plan.model
        factors = plans.widening[0], plans.state_widening[0]
        assert factors == pytest.approx(single.backup_plan.widening.factors)
        states[0, 3] = 0.0
    assert plans.state_widening[0] > 1.5 and plans.widening[1] == 1.0


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300])
def test_a_state_that_is_not_possible_costs_its_robot_one_period(value: float) -> None:
    """The other robots are decided as if it were not there; its past begins anew."""
    safety = one_step()
    plans, alone = BackupPlanBatch(safety, 3), BackupPlanBatch(safety, 2)
    free, given = [ObstacleArrays.of([Shapes.of([], 2)] * size) for size in (3, 2)], []
    for period in range(16):
        states, actions = np.zeros((3, 5)), np.tile([0.1, 0.0], (3, 1))
        states[1, 0] = value if period == 6 else 0.0
        outcome = plans.decide(states, actions, free[0])
        others = alone.decide(states[::2], actions[::2], free[1])
        assert outcome.decided.tolist() == [True, period != 6, True] and bool(outcome.failure) == (period == 6)
        assert (outcome.inputs[::2] == others.inputs).all() and np.isfinite(outcome.inputs).all()
        past = plans.request(states, actions, free[0]).past
        given.append([False] * 3 if past is None else past.given.tolist())
    N = plans.robot.horizon
    assert given[N : 6 + N] == [[True] * 3] * (6 - N) + [[True, False, True]] * N and given[6 + N] == [True] * 3
    assert plans.widening.tolist() == [alone.widening[0], plans.widening[1], alone.widening[1]]


@pytest.mark.parametrize("changes", [{"margin": math.nan}, {"rho": -0.1}, {"center": 1e300}, {"axes": 2.0}])
def test_an_obstacle_that_is_not_possible_costs_its_robot_alone_the_decision(changes: dict[str, float]) -> None:
    """That robot brakes along its plan, although nothing valid is known around it."""
    safety, post = one_step(), Shapes.of([Obstacle("cylinder", (0.9, 0.0), (0.1,))], 2)
    plans, alone = BackupPlanBatch(safety, 2), BackupPlanBatch(safety, 1)
    around, own, states = ObstacleArrays.of([post] * 2), ObstacleArrays.of([post]), np.zeros((2, 5))
    for period in range(4):
        damaged = {name: getattr(around, name).copy() for name in changes}
        for name, value in changes.items():
            damaged[name][0] = value
        now = replace(around, **damaged) if period == 2 else around
        outcome = plans.decide(states, np.tile([0.2, 0.0], (2, 1)), now)
        assert outcome.decided.tolist() == [period != 2, True] and bool(outcome.failure) == (period == 2)
        assert np.array_equal(outcome.inputs[1:], alone.decide(states[1:], np.array([[0.2, 0.0]]), own).inputs)
        if period == 2:
            assert outcome.answers is not None and outcome.answers.verified.tolist() == [False, True]
            assert outcome.answers.row(0).kind == FAILSAFE and outcome.inputs[0, 0] < 0.2


POST = Shapes.of([Obstacle("cylinder", (0.9, 0.0), (0.1,))], 2)
AROUND = ObstacleArrays.of([POST] * 2)


@pytest.mark.parametrize(
    "obstacles",
    [
        ObstacleArrays.of([POST] * 3),
        ObstacleArrays.of([Shapes.of([Obstacle("sphere", (0.9, 0.0, 0.0), (0.1,))], 3)] * 2),
        replace(AROUND, axes=AROUND.axes[..., 0]),
        replace(AROUND, rho=AROUND.rho[:, 0]),
        replace(AROUND, count=AROUND.count[:1]),
    ],
    ids=["another number of robots", "in space", "axes", "rho", "count"],
)
def test_obstacles_of_other_shapes_brake_all_robots_also_beside_an_invalid_state(obstacles: ObstacleArrays) -> None:
    plans = BackupPlanBatch(SAFETY, 2)
    outcome = plans.decide(np.array([[math.nan] * 5, [0.0] * 5]), np.tile([0.2, 0.0], (2, 1)), obstacles)
    assert not outcome.decided.any() and "obstacles" in outcome.failure and not outcome.inputs.any()


def test_an_observation_that_is_not_finite_costs_its_robot_alone_a_rivals_decision() -> None:
    observations = np.zeros((2, 3), np.float32)
    observations[0, 1] = np.nan
    plans, free = BackupPlanBatch(RowByRow(SAFETY), 2), ObstacleArrays.of([Shapes.of([], 2)] * 2)
    outcome = plans.decide(np.zeros((2, 5)), np.tile([0.2, 0.0], (2, 1)), free, observations)
    assert outcome.decided.tolist() == [False, True] and outcome.inputs.tolist() == [[0.0, 0.0], [0.2, 0.0]]
    assert np.isnan(observations[0, 1]), "the caller's array stays"


@pytest.mark.parametrize("shape", [(3, 5), (2, 4), (5,), (1, 5)])
def test_states_of_another_number_or_size_are_refused(shape: tuple[int, ...]) -> None:
    plans, free = BackupPlanBatch(SAFETY, 2), ObstacleArrays.of([Shapes.of([], 2)] * 2)
    with pytest.raises(BadRequest, match=r"states has shape .*: give \(2, 5\)"):
        plans.decide(np.zeros(shape), np.zeros((2, 2)), free)


def test_plans_of_other_robots_are_not_kept_in_batches() -> None:
    other = Broken(None)
    other.robot = robot_named("ground-late")
    with pytest.raises(ValueError, match="one robot at a time"):
        BackupPlanBatch(other, 2)  # type: ignore[arg-type]


def test_the_wrapper_filters_every_step_and_nothing_collides() -> None:
    """Robots that drive straight ahead never touch anything, and an episode begins with a standing plan."""
    env = BatchSafetyWrapper(BatchNavigationEnv(GROUND, 16, "dense"), SAFETY, penalty=1.0)
    env.reset(seed=1)
    contained = compared = 0
    for _ in range(60):
        *_, infos = env.step(np.tile([0.25, 0.0], (16, 1)))
        assert infos["outcome"].decided.all() and not infos["collision"].any()
        assert (infos["penalty"] >= 0.0).all()
        contained, compared = contained + infos["contained"].sum(), compared + infos["compared"].sum()
    assert compared > 900 and contained > 0.98 * compared
    assert BackupPlan(GROUND).plan.shape == env.plans.plan.shape[1:]
    env.close()


def test_a_step_that_resets_a_robot_compares_and_costs_nothing() -> None:
    arenas = BatchNavigationEnv(GROUND, 8, "dense", autoreset_mode=AutoresetMode.NEXT_STEP)
    env = BatchSafetyWrapper(arenas, SAFETY, penalty=1.0)
    env.reset(seed=0)
    arenas._step_limit = 12
    arenas._steps[::2] += 5  # episodes of every second robot end in the seventh step
    rng, ended = np.random.default_rng(0), np.zeros(8, dtype=bool)
    for _ in range(12):
        _, rewards, terminated, truncated, infos = env.step(rng.uniform([0.2, -0.5], [0.25, 0.5], (8, 2)))
        assert not (infos["compared"][ended].any() or infos["penalty"][ended].any() or rewards[ended].any())
        assert infos["compared"][~ended].all()
        ended = terminated | truncated
    assert ended.tolist() == [False, True] * 4
    env.reset(seed=1)
    env.step(np.tile([0.2, 0.0], (8, 1)))
    assert env.plans.input_in_force[:, 0].all(), "no robot is reset again"
    env.close()


class Single(BatchNavigationEnv):
    """It states its robots and obstacles in single precision, as simulators on a GPU do."""

    def _infos(self, rows: Any, period: Any) -> Any:
        infos = super()._infos(rows, period)
        shapes = {name: array.astype(np.float32) for name, array in infos["obstacles"].items() if name != "count"}
        return infos | {"state": infos["state"].astype(np.float32), "obstacles": infos["obstacles"] | shapes}


def test_states_and_obstacles_in_single_precision_are_decided() -> None:
    env = BatchSafetyWrapper(Single(GROUND, 2, "dense"), SAFETY)
    env.reset(seed=0)
    for _ in range(3):
        *_, infos = env.step(np.tile(np.float32([0.2, 0.0]), (2, 1)))
        assert infos["outcome"].decided.all() and infos["contained"].all()
    env.close()


class Overwriting(BatchNavigationEnv):
    """It overwrites the inputs that it gets."""

    def begin_step(self, inputs: Any) -> None:
        super().begin_step(inputs.copy())
        inputs[:] = 0.0


def test_an_environment_that_overwrites_its_inputs_changes_no_figure() -> None:
    env = BatchSafetyWrapper(Overwriting(GROUND, 2, "open"), SAFETY, penalty=1.0)
    env.reset(seed=0)
    *_, infos = env.step(np.tile([0.2, 0.0], (2, 1)))
    assert np.array_equal(infos["executed"], env.plans.input_in_force) and not infos["penalty"].any()
    infos["state"][:], infos["obstacles"]["count"][:] = 3.0, 0
    *_, infos = env.step(np.tile([0.2, 0.0], (2, 1)))
    assert infos["outcome"].answers.contained.all(), "a policy that overwrites a state changes no request"
    assert infos["outcome"].answers.obstacles.count.all(), "nor one that overwrites the obstacles"
    env.close()


def test_a_decision_names_the_obstacle_of_its_own_arena_also_after_a_reset() -> None:
    env = BatchSafetyWrapper(BatchNavigationEnv(GROUND, 8, "dense"), SAFETY, turn_aside=True)
    env.reset(seed=0)
    adjusted = 0
    while not adjusted:
        *_, infos = env.step(np.tile([0.25, 0.0], (8, 1)))
        adjusted = (infos["outcome"].answers.kind == KINDS.index(ADJUSTED)).sum()
    answers = infos["outcome"].answers
    before, center = [answers.row(i).blocked_by for i in range(8)], answers.obstacles.center.copy()
    env.reset(seed=1)
    assert [answers.row(i).blocked_by for i in range(8)] == before
    assert np.array_equal(answers.obstacles.center, center)
    env.close()


def test_a_policy_that_overwrites_its_observations_changes_none_that_a_rival_reads() -> None:
    method, read = RowByRow(SAFETY), []
    decide = method.decide_batch
    method.decide_batch = lambda requests: read.append(requests.observation) or decide(requests)  # type: ignore
    env = BatchSafetyWrapper(BatchNavigationEnv(GROUND, 2, "open"), method)
    observations, _ = env.reset(seed=0)
    seen = observations.copy()
    observations[:] = 0.5
    env.step(np.tile([0.2, 0.0], (2, 1)))
    assert np.array_equal(read[0], seen)
    env.close()


@pytest.mark.parametrize("options", [None, {}, {"reset_mask": None}, {"reset_mask": np.ones(2, dtype=bool)}])
def test_a_reset_of_all_robots_begins_all_plans_anew(options: Any) -> None:
    env = BatchSafetyWrapper(BatchNavigationEnv(GROUND, 2, "open"), SAFETY)
    env.reset(seed=0)
    env.step(np.tile([0.2, 0.0], (2, 1)))
    env.reset(seed=1, options=options)
    assert not env.plans.input_in_force.any() and not env.plans.predicted.given.any()
    env.close()


def test_a_period_under_way_ends_before_the_next_call() -> None:
    env = BatchSafetyWrapper(BatchNavigationEnv(GROUND, 2, "open"), SAFETY, penalty=1.0)
    env.reset(seed=0)
    actions = np.tile([0.25, 0.0], (2, 1))
    env.begin_step(actions)
    actions[:] = 0.0
    for call in (lambda: env.begin_step(actions), env.reset, lambda: env.env.begin_step(actions)):  # type: ignore[attr-defined]
        with pytest.raises(AlreadyPendingCallError, match="call end_step first"):
            call()
    *_, infos = env.end_step()
    assert infos["executed"][:, 0].tolist() == [0.25, 0.25] and not infos["penalty"].any(), "of the actions of then"
    assert infos["contained"].all() and infos["time"].tolist() == [0.2, 0.2]
    env.close()


def test_the_wrapper_refuses_an_environment_whose_steps_it_would_bypass() -> None:
    """It steps the innermost environment itself, so a wrapper inside it would see resets, and no steps."""
    env = BatchNavigationEnv(GROUND, 2)
    with pytest.raises(Mismatch, match="inside all other wrappers"):
        BatchSafetyWrapper(RecordEpisodeStatistics(env), SAFETY)
    RecordEpisodeStatistics(BatchSafetyWrapper(env, SAFETY)).close()
    vector = gymnasium.vector.SyncVectorEnv([lambda: NavigationEnv(GROUND)])
    with pytest.raises(Mismatch, match="VectorSafetyWrapper"):
        BatchSafetyWrapper(vector, SAFETY)
