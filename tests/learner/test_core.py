from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.errors import CheckpointError, DamagedPart, Diverged
from brakeline.learner.checkpoint import NOT_SAVED, PartState
from brakeline.learner.lagrange import LagrangeMultiplier
from brakeline.learner.learner import Learner
from brakeline.learner.learner_output import LearnerOutput
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging import policy_weights
from tests.full_disk import full_disk
from tests.learner.toy import CONFIG, TOY, ToyActor, run, settle


def joining(actor: str = "actor-0", **fields) -> pb.Join:
    return pb.Join(**({"robot": "toy", "actor": actor, "layout": TOY.learning_layout()} | fields))


def started(config=CONFIG) -> tuple[Learner, ToyActor]:
    learner = Learner(TOY, config)
    actor = ToyActor(learner)
    actor.join()
    return learner, actor


def finish(learner: Learner) -> ToyActor:
    """Run a learner to its end with an actor that joins now, and return the actor."""
    actor = ToyActor(learner)
    actor.join()
    run(learner, actor)
    return actor


@cache
def finished(config=CONFIG) -> Learner:
    """Return the learner of a run without interruption; read it only."""
    learner = Learner(TOY, config)
    finish(learner)
    return learner


def step(number: int, **fields) -> pb.Step:
    values = {"robot": "toy", "actor": "actor-0", "step": number - 1, "index": number, "action": [1.0]}
    values |= {"observation": [0.0, 0.0], "next_observation": [0.0, 0.0]} | fields
    return pb.Step(**({"proposed": values["action"]} | values))


def test_lockstep_runs_are_alike_bit_for_bit():
    one, other = finished(), finished.__wrapped__()
    assert one.weights().SerializeToString(deterministic=True) == other.weights().SerializeToString(deterministic=True)
    assert one.weights().version > 100
    assert (one.steps, one.updates) == (240, 180)
    assert finished(replace(CONFIG, seed=1)).weights().file != one.weights().file


@pytest.mark.parametrize("episodes", [1, 3, 8])  # in the warm-up, at its end, and when a shorter run has ended
@pytest.mark.parametrize("n_step", [1, 3])
def test_resumed_run_ends_with_the_same_bits(tmp_path, episodes, n_step):
    config = replace(CONFIG, td3=replace(CONFIG.td3, n_step=n_step))
    learner, actor = started(replace(config, steps=150))
    run(learner, actor, episodes)
    assert learner.may_save() and learner.steps == 20 * episodes, "also the episode in which step 150 falls"
    learner.save(tmp_path)
    run(learner, actor, 2)  # what a crash then loses

    resumed = Learner(TOY, replace(config, checkpoint_every=7), incarnation=1)
    resumed.restore(tmp_path)
    assert finish(resumed).episode == 240 / 20, "it went on with the episode after the checkpoint"
    assert resumed.weights().file == finished(config).weights().file
    assert (resumed.steps, resumed.metrics().missing) == (240, 0)


def test_it_learns():
    learner = Learner(TOY, replace(CONFIG, steps=1600))  # sums differ from processor to processor
    actor = finish(learner)
    assert np.mean(actor.rewards[-20:]) > 0.5 * np.mean(actor.rewards[:5])
    policy = policy_weights.decode(learner.weights().file, TOY)
    assert policy(np.array([-1.0, 1.0]))[0] > 1.5 and policy(np.array([1.0, -1.0]))[0] < 0.5


def test_a_step_is_read_with_its_reward_its_penalty_a_normalised_action_and_its_cut():
    learner, _ = started(replace(CONFIG, td3=replace(CONFIG.td3, n_step=1)))
    learner.insert(step(1, reward=2.0, penalty=0.5, action=[1.5]))
    tensors = learner._replay.state().tensors
    assert [float(tensors[name][0, 0]) for name in ("reward", "penalty", "action")] == [2.0, 0.5, 0.5]
    assert [learner._intake.move(step(2, cut=cut)).cut for cut in (False, True)] == [False, True]


def test_penalties_grow_during_the_training_also_those_of_old_steps():
    td3 = replace(CONFIG.td3, penalty_growth=3.0)
    learner, _ = started(replace(CONFIG, td3=td3, steps=12))
    factors = []
    for index in range(1, 9):
        learner.insert(step(index))
        factors.append(learner._td3.penalty_factor)
    assert factors == pytest.approx([1.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.0, 3.0])


def test_penalties_do_not_fall_when_a_resumed_training_gets_more_steps(tmp_path):
    config = replace(CONFIG, lockstep=False, td3=replace(CONFIG.td3, penalty_growth=3.0))
    learner, _ = started(replace(config, steps=12))
    for index in range(1, 6):
        learner.insert(step(index))
    learner.save(tmp_path)
    resumed = Learner(TOY, replace(config, steps=24), incarnation=1)
    resumed.restore(tmp_path)
    assert resumed._td3.penalty_factor == learner._td3.penalty_factor == pytest.approx(2.5)
    resumed.join(joining("actor-0", index=5))
    factors = []
    for index in range(6, 13):
        resumed.insert(step(index))
        factors.append(resumed._td3.penalty_factor)
    assert factors == pytest.approx([2.5, 2.5, 2.5, 2.5, 2.5, 2.75, 3.0])


def test_a_policy_that_a_full_disk_does_not_take_is_noted_until_it_is_saved(tmp_path):
    learner, _ = started()
    process = SimpleNamespace(notes={}, bus=SimpleNamespace(publisher=lambda *_, **__: None))
    output = LearnerOutput(process, learner, tmp_path)
    with full_disk(100):
        output.save()
    assert str(tmp_path / "policy.safetensors") in process.notes[NOT_SAVED] and not [*tmp_path.glob("policy*")]
    output.save()
    assert NOT_SAVED not in process.notes and (tmp_path / "policy.safetensors").exists()


def test_duplicates_and_gaps_are_counted():
    learner, _ = started()
    assert [learner.insert(step(index)) for index in (1, 2, 2, 5, 1)] == [True, True, False, True, False]
    metrics = learner.metrics()
    assert (metrics.steps, metrics.duplicates, metrics.missing) == (3, 2, 2)


def test_lockstep_takes_one_actor():
    learner, actor = started()
    assert learner.join(joining("actor-1")).error.field == "actor"
    assert not actor.join().HasField("error")


def test_a_late_joiner_gets_weights_and_its_place():
    learner, _ = started(replace(CONFIG, lockstep=False))
    reply = learner.join(joining("actor-1", index=100, episode=4))
    assert reply.episode == 4
    assert policy_weights.decode(reply.weights.file, TOY).version == reply.flow.weights_version == 1
    assert 100 < reply.flow.limit["actor-1"] <= 100 + CONFIG.window
    assert reply.flow.warmup and not reply.flow.done


def asynchronous(**changes) -> Learner:
    learner = Learner(TOY, replace(CONFIG, lockstep=False, window=8, ahead=20, publish_every=5, **changes))
    for actor in ("actor-0", "actor-1"):
        learner.join(joining(actor))
    return learner


def push_to_the_limit(learner: Learner) -> int:
    """Both actors publish all that they may; returns how many steps that was."""
    pushed, limits = 0, dict(learner.flow().limit)
    for actor, limit in limits.items():
        last = learner._ledger.places[actor].last_index
        for index in range(last + 1, limit + 1):
            learner.insert(step(index, actor=actor))
            pushed += 1
    return pushed


def test_flow_holds_actors_back_until_the_updates_are_made():
    learner = asynchronous()
    while push_to_the_limit(learner):
        pass
    assert 60 + 20 <= learner.steps <= 60 + 20 + 8  # warm-up, ahead, at most an actor's share more
    assert learner.flow().limit == learner.flow().limit
    version = learner.weights().version
    assert learner.work(10) == 10 and learner.weights_due()
    learner.publish()
    assert learner.flow().weights_version == version + 1 and not learner.weights_due()
    assert 0 < push_to_the_limit(learner) <= 20


@pytest.mark.parametrize("steps", [150, 400])  # the run ends before the first window is full; or after it
def test_many_actors_with_long_windows_do_not_wait_for_each_other(steps):
    learner = asynchronous(td3=replace(CONFIG.td3, n_step=20, warmup=60), steps=steps)
    names = [f"actor-{i}" for i in range(16)]
    taken = dict.fromkeys(names, 0)
    for name in names:
        learner.join(joining(name))
    for _ in range(steps):
        for name in names:
            if taken[name] < learner.flow().limit[name]:
                taken[name] += 1
                learner.insert(step(taken[name], actor=name))
        learner.work(1000)
    assert learner.done and learner.steps == steps
    assert learner.updates == (0 if steps == 150 else steps - 60)


def test_a_silent_actor_holds_up_nobody_and_the_run_ends_at_its_last_step():
    learner = asynchronous(steps=300)
    index = 0
    while not learner.flow().done:
        before = learner.updates + learner.steps
        while index < learner.flow().limit["actor-0"]:
            index += 1
            learner.insert(step(index))
        learner.work(1000)
        assert learner.updates + learner.steps > before
    assert learner.steps == 300
    assert learner.weights_due()  # the last updates, however few
    assert not learner.insert(step(301)) and learner.surplus == 1
    learner.join(joining(index=301, episode=1))  # an actor joins again while the last updates are made
    assert learner.metrics().missing == 0, "a step after the last one is refused, not lost"
    assert learner.metrics().done


def test_asynchronous_resume_keeps_open_windows_and_counts_what_was_lost(tmp_path):
    learner = asynchronous()
    for index in range(1, 6):
        learner.insert(step(index))
        learner.insert(step(index, actor="actor-1"))
    learner.save(tmp_path)
    again = asynchronous()
    again.restore(tmp_path)
    again.join(joining(index=9, episode=1))
    assert again.metrics().missing == 4
    assert not again.insert(step(5, actor="actor-1"))
    assert again.insert(step(6, actor="actor-1"))
    assert len(again._replay) == len(learner._replay) + 1  # the window that step 5 had left open


def test_checkpoints_fall_between_episodes():
    learner, _ = started(replace(CONFIG, checkpoint_every=30))
    for index in range(1, 41):
        learner.insert(step(index, truncated=index == 40))
        assert learner.checkpoint_due() == (index == 40)


def test_restore_refuses_what_is_not_this_run_and_names_a_part_of_another_shape(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint"):
        Learner(TOY, CONFIG).restore(tmp_path)
    learner, actor = started()
    run(learner, actor, 4)
    learner.save(tmp_path)
    for robot, config, what in (
        (TOY, replace(CONFIG, seed=3), "seed"),
        (TOY, replace(CONFIG, td3=replace(CONFIG.td3, gamma=0.5)), "td3"),
        (replace(TOY, period=0.1), CONFIG, "layout"),
    ):
        with pytest.raises(CheckpointError, match=what):
            Learner(robot, config).restore(tmp_path)
    other = Learner(TOY, CONFIG)
    other._replay.capacity += 1
    with pytest.raises(DamagedPart) as caught:
        other.restore(tmp_path)
    assert caught.value.part == "replay"


def test_a_diverged_training_keeps_its_last_checkpoint_and_its_last_weights(tmp_path):
    config = replace(CONFIG, td3=replace(CONFIG.td3, critic_rate=1e18, actor_rate=1e18))
    learner, actor = started(config)
    run(learner, actor, 2)
    assert learner.warming_up
    saved = learner.save(tmp_path)
    with pytest.raises(Diverged, match="lower learning rates"):
        run(learner, actor)
    with pytest.raises(Diverged):
        learner.save(tmp_path)
    policy_weights.decode(learner.weights().file, TOY)  # which refuses numbers that are not finite
    resumed = Learner(TOY, config)
    resumed.restore(tmp_path)
    assert resumed.steps == 40 and [path.name for path in tmp_path.glob("0*")] == [saved.name]


def test_a_checkpoint_of_a_diverged_training_is_refused(tmp_path, monkeypatch):
    learner, actor = started()
    run(learner, actor, 4)
    learner._td3.critics.parameters[3] = float("inf")
    monkeypatch.setattr(learner, "_check_finite", lambda: None)  # as in versions before there was this check
    learner.save(tmp_path)
    with pytest.raises(DamagedPart, match="not finite"):
        Learner(TOY, CONFIG).restore(tmp_path)


def test_figures():
    now = [0.0]
    learner = Learner(TOY, CONFIG, clock=lambda: now[0])
    actor = ToyActor(learner)
    actor.join()
    run(learner, actor, 5)
    now[0] = 2.0
    settle(learner)
    metrics = learner.metrics()
    assert (metrics.steps, metrics.steps_per_s, metrics.updates, metrics.updates_per_s) == (100, 50.0, 40, 20.0)
    assert metrics.critic_loss > 0.0 and metrics.staleness == 0.0 and metrics.limiter_error == 0.0
    assert learner.metrics().steps_per_s == 0.0


LIMITED = replace(CONFIG, td3=replace(CONFIG.td3, cost_limit=0.1, multiplier_rate=4.0))


def test_the_multiplier_rises_with_collisions_and_falls_to_zero_without():
    learner, _ = started(LIMITED)
    values = []
    for index, collided in enumerate((True, False, True, *[False] * 20), start=1):
        learner.insert(step(index, episode=index - 1, step=0, terminated=True, collision=collided))
        values.append(learner._td3.cost_weight)
    assert values[:3] == pytest.approx([3.6, 3.2, 6.8]) and values[-1] == 0.0
    free, _ = started(CONFIG)
    free.insert(step(1, terminated=True, collision=True))
    assert free._td3.cost_weight == 0.0


@pytest.mark.parametrize("touched", ["collision", "contact_moving", "contact_robot"])
def test_what_the_robot_runs_into_is_a_cost_also_if_it_moves(touched):
    learner, _ = started(LIMITED)
    learner.insert(step(1, terminated=True, **{touched: True}))
    assert learner._td3.cost_weight == pytest.approx(3.6)
    assert learner._replay.state().tensor("cost", (1, 1), "float32") == 1.0


def test_a_resumed_run_keeps_the_multiplier(tmp_path):
    learner, _ = started(LIMITED)
    learner.insert(step(1, terminated=True, collision=True))
    learner.save(tmp_path)
    resumed = Learner(TOY, LIMITED)
    resumed.restore(tmp_path)
    assert resumed._td3.cost_weight == learner._td3.cost_weight == pytest.approx(3.6)
    for wrong in ("3.6", float("nan"), -1.0):
        with pytest.raises(ValueError, match="no multiplier"):
            LagrangeMultiplier(0.1, 1.0).restore(PartState({}, {"value": wrong}))
