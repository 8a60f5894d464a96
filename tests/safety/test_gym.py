"""The wrapper and its vector form in front of small environments, and data that these environments record."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

from brakeline.deploy.data.environment_episodes import collect
from brakeline.errors import BadData, BadModel, BadRequest, Mismatch, NoReply
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.scan import MAX_SCAN_AGE, Scan
from brakeline.safety.action_mapping import ActionMapping, action_for, mapping_for_space, normalised
from brakeline.safety.environment_views import STATE
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import NOT_FINITE
from brakeline.safety.gym import UNANSWERED, SafetyWrapper
from brakeline.safety.gym_vector import VectorSafetyWrapper
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.service.client import SafetyClient
from brakeline.safety.service.in_process import InProcess
from brakeline.sim.registration import ENVIRONMENTS, register
from tests.safety.toys import SUBSTEPS, Toy, car, discs, near, puck, seen

CAR, PUCK = car("gym-car"), puck("gym-puck")
HOW = {"state": seen, "obstacles": near, "actions": normalised(CAR)}
SCANNED = {"state": seen, "actions": normalised(CAR)}


def wrapped(env, ready, many=False, penalty=0.0, **how):
    """Wrap one environment, or a vector that holds it alone, and reset it."""
    if many:
        one = env
        env = gymnasium.vector.SyncVectorEnv([lambda: one])
    env = (VectorSafetyWrapper if many else SafetyWrapper)(env, ready, penalty, accept_bound=1.0, **how)
    env.reset(seed=0)
    return env


@pytest.fixture(scope="module")
def data():
    return collect(Toy(CAR, steps=10_000), CAR, 2500, state=seen, actions=normalised(CAR), shown=False)


@pytest.fixture(scope="module")
def model(data):
    return fit_model_set(data, ModelConfig())


@pytest.fixture(scope="module")
def ready(model):
    return Filter(model)


PAIR = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2).map(np.array)


@given(PAIR, PAIR)
def test_normalised_actions_become_inputs_and_inputs_actions(there, share):
    between, wanted = normalised(CAR), 2.0 * there - 1.0
    control = between.action_to_control(wanted)
    assert (control >= CAR.low()).all() and (control <= CAR.high()).all()
    assert np.allclose(between.control_to_action(control), wanted, atol=1e-12)
    control = CAR.low() + share * (CAR.high() - CAR.low())
    action = between.control_to_action(control)
    assert (np.abs(action) <= 1.0).all()
    assert np.allclose(between.action_to_control(action), control, atol=1e-12)


def test_normalised_actions_are_never_taken_for_inputs(ready):
    with pytest.raises(Mismatch, match=r"speed \[m/s\] from 0 to 0.6.*actions=normalised\(robot\)"):
        SafetyWrapper(Toy(CAR), ready, accept_bound=1.0)
    with pytest.raises(Mismatch, match="normalised"):
        collect(Toy(CAR), CAR, 10, state=seen, shown=False)


@pytest.mark.parametrize("space", [gymnasium.spaces.Discrete(4), gymnasium.spaces.Box(-1.0, 1.0, (3,))])
def test_an_action_space_of_another_kind_is_refused_unless_mapped(space):
    with pytest.raises(Mismatch, match="action_to_control"):
        mapping_for_space(space, CAR, None)
    mapped = ActionMapping(lambda action: action, lambda control: control)
    assert mapping_for_space(space, CAR, mapped) is mapped


def test_an_error_names_the_missing_entry(ready):
    with pytest.raises(gymnasium.error.ResetNeeded):
        SafetyWrapper(Toy(CAR), ready, accept_bound=1.0, **HOW).step(np.zeros(2))
    with pytest.raises(Mismatch, match=r"no 'state' \(the measured state.*give state=, a callable"):
        wrapped(Toy(CAR), ready, actions=normalised(CAR)).step(np.zeros(2))
    with pytest.raises(Mismatch, match="no 'obstacles'"):
        wrapped(Toy(CAR), ready, **SCANNED).step(np.zeros(2))
    assert STATE(None, None, {"state": 3}) == 3


def test_the_wrapper_from_a_file_reports_its_decisions(tmp_path, model):
    model.save(tmp_path / "model.safetensors")
    env = SafetyWrapper.load(Toy(CAR, discs()), tmp_path / "model.safetensors", penalty=1.0, accept_bound=1.0, **HOW)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.array([-1.0, 0.0]))
    diagnostics = info["diagnostics"]
    assert diagnostics["kind"] == info["safety"].kind == "allowed"
    assert diagnostics["verified"] and diagnostics["margin"] > 0.0
    assert np.array_equal(diagnostics["executed"], [0.0, 0.0]) and np.array_equal(diagnostics["proposed"], [0.0, 0.0])
    assert reward == -info["penalty"] == 0.0
    assert ModelSet.load(tmp_path / "model.safetensors").version == diagnostics["model"]


def test_the_wrapper_takes_the_name_of_a_shipped_robot():
    env = SafetyWrapper.load(gymnasium.make("brakeline.envs:brakeline/Ground-v0"), "ground")
    assert env.client.robot.name == "ground"
    with pytest.raises(BadModel, match=r"no model set comes with 'grond'; there are: ground, quadrotor"):
        SafetyWrapper.load(env.unwrapped, "grond")


def test_the_wrapper_passes_a_safe_action_and_clipping_costs_nothing(ready):
    env = wrapped(Toy(CAR), ready, penalty=2.0, **HOW)
    for action in np.array([[0.3, 0.5], [9.0, 0.0]], np.float32):
        _, reward, _, _, info = env.step(action)
        executed = normalised(CAR).action_to_control(np.clip(action, -1.0, 1.0))
        assert info["safety"].kind == "allowed" and np.allclose(info["diagnostics"]["executed"], executed, atol=1e-12)
        assert reward == info["penalty"] == 0.0


def test_the_wrapper_replaces_and_penalises_unsafe_actions(ready):
    toy = Toy(CAR, discs(count=12))
    env, kinds, penalties = wrapped(toy, ready, penalty=2.0, **HOW), set(), []
    for _ in range(60):
        _, reward, _, _, info = env.step(np.array([1.0, 0.0], np.float32))
        kinds.add(info["safety"].kind)
        off = np.linalg.norm((info["safety"].action - info["diagnostics"]["proposed"]) / (CAR.high() - CAR.low()))
        penalties.append(-reward)
        assert penalties[-1] == info["penalty"] == pytest.approx(2.0 * off)
    assert "adjusted" in kinds and max(penalties) > 1.0 and toy.worst > 0.0


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -float("inf")])
def test_a_proposal_that_is_not_finite_is_a_failsafe(ready, wrong):
    """Also through a mapping that clips."""
    _, reward, _, _, info = wrapped(Toy(CAR), ready, penalty=1.0, **HOW).step(np.array([wrong, 0.1], np.float32))
    diagnostics = info["diagnostics"]
    assert not diagnostics["executed"].any() and np.isfinite(reward)
    assert (diagnostics["kind"], diagnostics["verified"], diagnostics["reason"]) == ("failsafe", True, NOT_FINITE)


class Overwriting(Toy):
    """An environment that takes inputs, and halves the array that it gets."""

    action_space = gymnasium.spaces.Box(CAR.low(), CAR.high(), dtype=np.float64)

    def step(self, action):
        self.got = action.copy()
        action *= 0.5
        return super().step(normalised(CAR).control_to_action(self.got).astype(np.float32))


def mirrored(inputs):
    """Change the sign of the curvature in place."""
    inputs[..., 1] *= -1.0
    return inputs


@pytest.mark.parametrize("actions", [None, ActionMapping(lambda action: action * [1.0, -1.0], mirrored)])
@pytest.mark.parametrize("many", [False, True])
def test_an_environment_or_a_mapping_that_overwrites_what_it_gets_changes_no_figure(ready, many, actions):
    """The executed input is the input in force of the next request: it was the overwritten one."""
    toy, free = Overwriting(CAR), (lambda *_: [[]]) if many else near
    env = wrapped(toy, ready, many, penalty=1.0, state=seen, obstacles=free, actions=actions)
    proposed = np.array([0.4, 0.6])
    for _ in range(3):
        _, reward, *_, info = env.step(proposed[None] if many else proposed)
        executed = np.reshape(info["diagnostics"]["executed"], 2)
        sign = 1.0 if actions is None else -1.0
        plan = env.backup_plans[0] if many else env.backup_plan
        assert np.array_equal(toy.got, executed * [1.0, sign]) and np.array_equal(executed, plan.input_in_force)
        assert np.array_equal(executed, [0.4, 0.6 * sign]) and not np.any(reward)


class Informed(Toy):
    """It also reports the state in an info, as a plain array and in a dict."""

    def reset(self, **how):
        observation, _ = super().reset(**how)
        return observation, {"state": observation.copy(), "more": {"state": observation.copy()}}

    def step(self, action):
        observation, *ended, _ = super().step(action)
        return observation, *ended, {"state": observation.copy(), "more": {"state": observation.copy()}}


@pytest.mark.parametrize("place", [lambda o, i: o, lambda o, i: i["state"], lambda o, i: i["more"]["state"]])
@pytest.mark.parametrize("many", [False, True])
def test_a_policy_that_overwrites_what_it_observes_changes_no_decision(ready, many, place):
    """A policy normalises its observation in place. The next request measured that."""
    free = (lambda *_: [[]]) if many else near
    how = HOW | {"state": lambda env, observation, info: place(observation, info), "obstacles": free}
    env, sound = (wrapped(Informed(CAR), ready, many, **how) for _ in range(2))
    action, returned = np.full((1, 2) if many else 2, 0.3, np.float32), env.reset(seed=0)
    sound.reset(seed=0)
    for _ in range(4):
        place(*returned)[...] = 3.0
        observation, *_, info = env.step(action)
        returned, (*_, wanted) = (observation, info), sound.step(action)
        assert np.array_equal(info["safety"], wanted["safety"]) if many else info["safety"] == wanted["safety"]


class Listing(Toy):
    """It reports the state, and an obstacle in a list."""

    def reset(self, **how):
        return self._listed(*super().reset(**how))

    def step(self, action):
        *returned, info = super().step(action)
        return *returned, self._listed(returned[0], info)[1]

    def _listed(self, observation, info):
        return observation, info | {"state": observation, "obstacles": [Obstacle("cylinder", (1.0, 0.0), (0.1,))]}


@pytest.mark.parametrize("many", [False, True])
def test_a_policy_that_empties_the_list_of_obstacles_frees_no_space(ready, many):
    """An empty list means that all space is free. A policy may take the obstacles out of the list one by one."""
    env, sound = (wrapped(Listing(CAR), ready, many, actions=normalised(CAR)) for _ in range(2))
    info, action = env.reset(seed=0)[1], np.full((1, 2) if many else 2, 0.3, np.float32)
    sound.reset(seed=0)
    for _ in range(3):
        (info["obstacles"][0] if many else info["obstacles"]).clear()
        (*_, info), (*_, wanted) = env.step(action), sound.step(action)
        assert info["diagnostics"]["margin"] == wanted["diagnostics"]["margin"]


@pytest.mark.parametrize("centimetres", [0, 28, 29, 57, 58, 60])
def test_an_action_in_whole_units_is_the_input_that_was_decided(centimetres):
    space = gymnasium.spaces.Box(0, 60, (2,), np.int32)
    in_cm = ActionMapping(lambda action: action / 100.0, lambda control: 100.0 * control)
    action = action_for(in_cm.action_to_control(np.array([centimetres, 0])), in_cm, space)
    assert action.dtype == np.int32 and action.tolist() == [centimetres, 0]


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("wanted", [False, True])
def test_a_wrapper_leaves_a_client_that_turns_aside_as_it_is(ready, asked, wanted):
    client = InProcess(ready, accept_bound=1.0)
    client.backup_plan.turn_aside = asked
    assert wrapped(Toy(CAR), client, turn_aside=wanted, **HOW).backup_plan.turn_aside == (asked or wanted)


def test_collecting_from_an_environment_that_overwrites_its_actions_records_what_was_driven():
    env = Overwriting(CAR)
    data = collect(env, CAR, 30, held=8, state=seen, shown=False)
    assert np.array_equal(data.trajectories[-1].inputs[-1], env.got)


def test_every_episode_starts_standing(ready):
    env = wrapped(Toy(CAR), ready, **HOW)
    env.step(np.array([1.0, 0.1], np.float32))
    assert env.backup_plan.input_in_force.any()
    env.reset(seed=4)
    assert not env.backup_plan.input_in_force.any() and env.backup_plan.predicted is None


class Silent(SafetyClient):
    """A client whose service does not answer."""

    def __init__(self):
        super().__init__(None, CAR)

    def decide(self, *values, **more):
        self.asked = more
        raise NoReply("nobody serves")


def test_without_a_service_the_backup_plan_continues():
    client = Silent()
    env = SafetyWrapper(Toy(CAR), client, **HOW)
    observation, _ = env.reset(seed=0)
    *_, info = env.step(np.array([1.0, 0.0]))
    assert info["diagnostics"]["kind"] == UNANSWERED and "nobody serves" in info["diagnostics"]["reason"]
    assert not info["diagnostics"]["executed"].any(), "the robot stands"
    assert np.array_equal(client.asked["observation"], observation.astype(np.float32)), "the rivals need it"


@pytest.mark.parametrize("mode", list(gymnasium.vector.AutoresetMode))
def test_a_vector_decides_as_its_environments_do_alone(ready, mode):
    count, policy = 3, np.random.default_rng(5)
    make_one = lambda: Toy(CAR, discs(), steps=12)  # noqa: E731
    vector = gymnasium.vector.SyncVectorEnv([make_one] * count, autoreset_mode=mode)
    views = {
        "state": seen,
        "obstacles": lambda env, *_: [near(one, None, {}) for one in env.unwrapped.envs],
        "actions": normalised(CAR),
    }
    many = VectorSafetyWrapper(vector, ready, 0.5, accept_bound=1.0, **views)
    observations, _ = many.reset(seed=[0, 1, 2])
    alone = [InProcess(ready, accept_bound=1.0) for _ in range(count)]
    fresh = np.zeros(count, dtype=bool)  # environments that the next step resets
    for _ in range(30):
        actions = policy.uniform(-1.0, 1.0, (count, 2)).astype(np.float32)
        resets = fresh if mode == gymnasium.vector.AutoresetMode.NEXT_STEP else np.zeros(count, dtype=bool)
        wanted = []
        for i in np.flatnonzero(~resets):
            proposed = normalised(CAR).action_to_control(actions[i])
            wanted.append((i, alone[i].decide(observations[i], proposed, discs())))
        observations, rewards, terminated, truncated, infos = many.step(actions)
        for i, decision in wanted:
            assert np.array_equal(infos["safety"][i].plan, decision.plan)
            assert rewards[i] == -infos["penalty"][i]
        assert [one is None for one in infos["safety"]] == resets.tolist()
        executed, proposed = (infos["diagnostics"][name] for name in ("executed", "proposed"))
        assert np.array_equal(proposed, normalised(CAR).action_to_control(actions))
        for i, decision in wanted:
            assert np.array_equal(executed[i], decision.action)
        ended = terminated | truncated
        if mode == gymnasium.vector.AutoresetMode.DISABLED and ended.any():
            observations, _ = many.reset(options={"reset_mask": ended})
        for i in np.flatnonzero(resets if mode == gymnasium.vector.AutoresetMode.NEXT_STEP else ended):
            alone[i].reset()
        fresh = ended
    assert infos["diagnostics"]["kind"].shape == (count,)


@pytest.mark.filterwarnings("ignore:.*(symmetric and normalized space|different from the unwrapped version).*")
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_wrapped_environment_passes_the_check_of_gymnasium(name):
    register()
    ready = Filter.load(ENVIRONMENTS[name])
    env = SafetyWrapper(gymnasium.make(name), ready, penalty=1.0)
    check_env(env, skip_render_check=True)
    assert env.step(np.zeros(env.action_space.shape))[4]["safety"].time_ms > 0.0
    assert env.spec.make().penalty == 1.0
    with pytest.raises(TypeError, match="filter"):  # two robots must not share a backup plan
        SafetyWrapper(gymnasium.make(name), InProcess(ready)).spec.make()


def test_two_environments_never_share_a_client(ready):
    """It has one backup plan: with that of the other robot, each would stand before no obstacle, without a word."""
    client = InProcess(ready, accept_bound=1.0)
    first, second = (SafetyWrapper(Toy(CAR), client, **HOW) for _ in range(2))
    for env in (first, second, first):  # one after the other is allowed
        env.reset(seed=0)
        env.step(np.ones(2, np.float32))
    second.reset(seed=0)
    with pytest.raises(Mismatch, match="another environment uses this client"):
        first.step(np.ones(2, np.float32))
    second.step(np.ones(2, np.float32))


class Faulty(Toy):
    """An environment with the state and the obstacles in its info. In the second step one of them fails."""

    def __init__(self, fault, **how):
        super().__init__(CAR, discs(), **how)
        self.fault = fault

    def reset(self, **how):
        observation, info = super().reset(**how)
        return observation, info | {"state": observation, "obstacles": self.obstacles}

    def step(self, action):
        observation, *ended, _ = super().step(action)
        info = {"state": observation.copy(), "obstacles": self.obstacles}
        if self.count == 2 and self.fault in info:
            del info[self.fault]
        elif self.count == 2:
            info["state"][0] = {"nan": np.nan, "far": 1e9}.get(self.fault, observation[0])
        return observation, *ended, info


@pytest.mark.parametrize("fault", ["nan", "far"])
def test_a_state_that_is_not_finite_or_not_plausible_continues_the_backup_plan(ready, fault):
    env = wrapped(Faulty(fault), ready, actions=normalised(CAR))
    figures = [env.step(np.ones(2, np.float32))[4]["diagnostics"] for _ in range(4)]
    assert [one["kind"] == UNANSWERED for one in figures] == [False, False, True, False]
    assert figures[2]["reason"].startswith(("state holds NaN", "a state beyond"))
    assert figures[2]["executed"][0] < figures[1]["executed"][0], "it brakes"
    with pytest.raises(BadRequest, match="shape"):
        wrapped(Toy(CAR), ready, **HOW | {"state": lambda *_: np.zeros(3)}).step(np.ones(2, np.float32))


@pytest.mark.parametrize("fault", ["nan", "far", "state", "obstacles"])
def test_a_vector_brakes_the_robot_alone_whose_state_or_obstacles_are_missing(ready, fault):
    faults = ("", fault, "")
    vector = gymnasium.vector.SyncVectorEnv([lambda one=one: Faulty(one) for one in faults])
    env = VectorSafetyWrapper(vector, ready, accept_bound=1.0, actions=normalised(CAR))
    sound = VectorSafetyWrapper(
        gymnasium.vector.SyncVectorEnv([lambda: Faulty("")] * 3), ready, accept_bound=1.0, actions=normalised(CAR)
    )
    for each in (env, sound):
        each.reset(seed=[0, 0, 0])
    for count in range(1, 5):
        infos, wanted = (each.step(np.ones((3, 2), np.float32))[4] for each in (env, sound))
        for i in (0, 2):
            assert np.array_equal(infos["safety"][i].plan, wanted["safety"][i].plan), "the others are not concerned"
        kind, reason = infos["diagnostics"]["kind"][1], infos["diagnostics"]["reason"][1]
        assert (infos["safety"][1] is None) == (kind == UNANSWERED) == (count == 3)
        if count == 3:
            assert reason.startswith(("state holds NaN", "a state beyond", f"{fault} is missing"))
            assert (env.backup_plans[1].input_in_force < env.backup_plans[0].input_in_force)[0], "it brakes"


WITHIN = Obstacle("box", (0.0, 0.0), (0.1, 0.1))  # at the start of every toy


def test_a_vector_reads_each_list_of_obstacles_once(ready):
    """It asks again if a state cannot be used. An iterator would then be at its end, as if all space were free."""
    kinds = []
    for kind in (list, iter):
        vector = gymnasium.vector.SyncVectorEnv([lambda one=one: Faulty(one) for one in ("", "nan")])
        env = VectorSafetyWrapper(
            vector,
            ready,
            accept_bound=1.0,
            actions=normalised(CAR),
            obstacles=lambda *_, kind=kind: [kind([WITHIN]) for _ in range(2)],
        )
        env.reset(seed=[0, 0])
        kinds.append([env.step(np.ones((2, 2), np.float32))[4]["diagnostics"]["verified"].tolist() for _ in range(4)])
    assert kinds[0] == kinds[1]


class Walled(Toy):
    """An environment with a scan instead of obstacles: a wall all around."""

    FAN = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    blind = False  # from now on no scan comes

    def _with_scan(self, info):
        scan = Scan(np.full(360, 0.5), self.FAN, (*info["state"][:2], info["state"][2]))
        return info | {"scan": None if self.blind else scan}

    def reset(self, **how):
        observation, info = super().reset(**how)
        return observation, self._with_scan(info | {"state": observation})

    def step(self, action):
        observation, *ended, info = super().step(action)
        return observation, *ended, self._with_scan(info | {"state": observation})


def test_one_environment_and_a_vector_decide_by_scans(ready):
    margins = []
    for many in (False, True):
        action, blind = np.ones((1, 2) if many else 2, np.float32), Walled(CAR)
        *_, info = wrapped(Walled(CAR), ready, many, **SCANNED).step(action)
        margins.append(float(np.squeeze(info["diagnostics"]["margin"])))
        blind.blind = True
        *_, info = wrapped(blind, ready, many, **SCANNED).step(action)
        assert np.all(info["diagnostics"]["kind"] == "failsafe"), "before the first scan, nothing is free"
    assert margins[0] == margins[1] < 0.3, "the wall is near"


class Mapped(Walled):
    """An environment with the state, the obstacles and a scan in its info."""

    def _with_scan(self, info):
        return super()._with_scan(info | {"obstacles": self.obstacles})


def test_a_masked_reset_leaves_the_other_robots_as_they_are(ready):
    ends = (2, 60)
    vector = gymnasium.vector.SyncVectorEnv(
        [lambda steps=steps: Mapped(CAR, discs(), steps=steps) for steps in ends],
        autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED,
    )
    env = VectorSafetyWrapper(vector, ready, accept_bound=1.0, actions=normalised(CAR))
    env.reset(seed=[0, 1])
    for _ in range(ends[0]):
        observations, _, _, ended, infos = env.step(np.ones((2, 2), np.float32))
    plan, predicted, scan, options = env.backup_plans[1].plan, env.backup_plans[1].predicted, env._scans[1], {}
    options["reset_mask"] = ended.copy()
    observations, after = env.reset(options=options)
    assert options["reset_mask"].tolist() == [True, False], "the caller's options stay"
    assert not env.backup_plans[0].input_in_force.any() and env.backup_plans[0].predicted is None
    assert env.backup_plans[1].plan is plan and env.backup_plans[1].predicted is predicted
    assert np.array_equal(after["state"], observations) and after["_state"].all()
    assert np.array_equal(after["state"][1], infos["state"][1]) and after["obstacles"][1] == infos["obstacles"][1]
    assert env._scans[1] is scan, "no time passes"
    *_, infos = env.step(np.ones((2, 2), np.float32))
    assert infos["safety"][1].compared and infos["safety"][1].contained


def test_a_vector_view_without_lists_is_refused(ready):
    env = wrapped(Toy(CAR, discs()), ready, many=True, obstacles=lambda *_: [], **SCANNED)
    with pytest.raises(Mismatch, match="0 lists for 1 environments: give a list for each"):
        env.step(np.ones((1, 2), np.float32))


@pytest.mark.parametrize("many", [False, True], ids=["one", "vector"])
def test_an_empty_list_means_free_space_and_none_means_unknown_space(ready, many):
    def stepped(near):
        env = wrapped(Toy(CAR), ready, many, obstacles=lambda *_: [near] if many else near, **SCANNED)
        *_, info = env.step(np.ones((1, 2) if many else 2, np.float32))
        return info["diagnostics"]["kind"]

    assert np.all(stepped([]) == "allowed")
    with pytest.raises(BadRequest, match="known_free"):
        stepped(None)


def test_a_vector_with_obstacles_as_arrays_is_sent_to_its_wrapper(ready):
    env = wrapped(Toy(CAR), ready, many=True, obstacles=lambda *_: {"centers": np.zeros((1, 0, 2))}, **SCANNED)
    with pytest.raises(Mismatch, match="use BatchSafetyWrapper"):
        env.step(np.ones((1, 2), np.float32))


def test_a_missing_scan_frees_nothing(ready):
    env = wrapped(Walled(CAR), ready, **SCANNED)
    *_, before = env.step(np.array([-1.0, 0.0]))
    env.unwrapped.blind = True
    for _ in range(3):
        *_, after = env.step(np.array([-1.0, 0.0]))
    assert after["scan"] is None
    assert after["diagnostics"]["margin"] == pytest.approx(before["diagnostics"]["margin"], abs=0.02)
    for _ in range(round(MAX_SCAN_AGE / CAR.period) + CAR.horizon):
        *_, after = env.step(np.array([1.0, 0.0]))
    figures = after["diagnostics"]
    assert figures["kind"] == "failsafe" and "s old" in figures["reason"], "an old scan frees nothing either"
    assert CAR.is_stop_input(figures["executed"])


def test_collecting_drops_episodes_that_end_in_a_collision(data):
    assert data.periods == 2500 and len(data.trajectories) == 9
    env = Toy(CAR, discs(away=0.45), steps=10_000)
    cut = collect(env, CAR, 200, held=8, state=seen, actions=normalised(CAR), shown=False)
    assert len(cut.trajectories) > 3, "it ran into something, and began again"
    bumps = [t for t in cut.trajectories if len(t.inputs) > 1]
    gaps = [np.linalg.norm(t.states[:, None, :2] - [d.position for d in discs(away=0.45)], axis=2).min() for t in bumps]
    assert min(gaps) > 0.3 - 1e-9, "no state in which it touched one is in the data"


def test_collecting_splits_where_something_else_moved_the_robot():
    pushed = lambda env, observation, info: env.unwrapped.count % 10 == 0  # noqa: E731
    cut = collect(Toy(CAR), CAR, 54, state=seen, actions=normalised(CAR), disturbed=pushed, shown=False)
    assert [len(t.inputs) for t in cut.trajectories] == [9, 9, 9, 9, 9, 4, 5]
    assert cut.trajectories[0].before is None and cut.trajectories[1].before is not None


def test_collecting_copies_what_the_environment_writes_again():
    class Buffered(Toy):
        path = np.zeros((2, 2))

        def step(self, action):
            *result, info = super().step(action)
            self.path[:] = self.count
            return *result, info | {"subsamples": self.path}

    data = collect(Buffered(CAR), CAR, 20, state=seen, actions=normalised(CAR), shown=False)
    assert list(data.trajectories[0].paths[:, 0, 0]) == list(range(1, 21))


@pytest.mark.parametrize("samples", [1, 2, 5])
def test_collecting_states_how_far_the_path_leaves_the_lines_between_the_samples(samples):
    class Sampled(Toy):
        def step(self, action):
            before, number = self.state[:2], len(self.trace)
            *result, info = super().step(action)
            path = np.array(self.trace[number:])[:, :2] - before
            return *result, info | {"subsamples": path[len(path) // samples - 1 :: len(path) // samples]}

    env = Sampled(PUCK)
    data = collect(env, PUCK, 60, held=2, state=seen, actions=normalised(PUCK), shown=False)
    assert data.trajectories[0].paths.shape[1] == samples
    corners = np.vstack([np.zeros((1, 2)), np.array(env.trace)[:, :2]])
    per, share = SUBSTEPS // samples, np.linspace(0.0, 1.0, SUBSTEPS // samples + 1)[:, None]
    chords = [corners[i : i + per + 1] for i in range(0, len(corners) - 1, per)]
    away = max(np.linalg.norm(c - c[0] - share * (c[-1] - c[0]), axis=1).max() for c in chords)
    assert 0.0 < away <= data.chord_deviation < 6.0 * away


def test_collecting_refuses_a_chord_deviation_that_is_no_length_before_it_drives():
    env = Toy(PUCK)
    with pytest.raises(BadData, match=r"the chord deviation .* is no length"):
        collect(env, PUCK, 60, state=seen, actions=normalised(PUCK), chord_deviation=-0.01, shown=False)
    assert not hasattr(env, "count")


def test_collecting_gives_up_if_every_episode_ends_at_once():
    with pytest.raises(BadData, match="in a row ended before period"):
        collect(Toy(CAR, [Obstacle("cylinder", (0.0, 0.0), (0.1,))]), CAR, 10, state=seen, actions=normalised(CAR))


def test_a_stop_by_feedback_follows_the_measured_state():
    data = collect(Toy(PUCK), PUCK, 300, held=8, state=seen, actions=normalised(PUCK), shown=False)
    t = data.trajectories[0]
    braked = PUCK.stop_by_feedback(np.zeros_like(t.inputs), t.states[:-1], np.vstack([np.zeros((1, 2)), t.inputs[:-1]]))
    follows = (np.abs(t.inputs - braked) < 1e-9).all(1)
    assert 0.3 < follows.mean() < 0.95


@given(st.floats(0.0, 0.05), st.floats(-1.0, 1.0))
def test_a_puck_keeps_still_only_by_its_feedback(residual, push):
    state = np.array([0.0, 0.0, residual, 0.0])
    for sideways, standing in ((0.0, residual <= PUCK.stopped), (push, residual <= PUCK.stopped and abs(push) <= 2e-6)):
        backup_plan, plan = BackupPlan(PUCK), np.zeros((PUCK.horizon, 2))
        backup_plan.seen = state
        plan[0] = PUCK.stop_by_feedback(plan[0], state, plan[0])
        plan[0, 1] += sideways
        backup_plan.accept(plan, "v", None, True)
        assert backup_plan.model == ("" if standing else "v")
