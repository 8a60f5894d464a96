"""What becomes of a stream of steps: ledger, windows, replay, rate limiter."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.learner.checkpoint import PartState
from brakeline.learner.n_step import ActorStep, NStepWindows
from brakeline.learner.rate_limiter import RateLimiter
from brakeline.learner.replay import Batch, ReplayBuffer, Transition
from brakeline.learner.step_ledger import StepLedger, mark

GAMMA = 0.9


def move(episode: int, step: int, reward: float, terminated: bool = False, truncated: bool = False) -> ActorStep:
    name = np.array([episode, step], np.float32)  # a vector that says which step it is of
    after = name + np.array([0, 1], np.float32)
    return ActorStep(episode, step, name, name, name, reward, 0.0, after, terminated, truncated)


@given(st.lists(st.integers(0, 30)))
def test_ranges_are_the_set_that_was_marked(steps):
    ranges, seen = [], set()
    for step in steps:
        assert mark(ranges, step) == (step not in seen)
        seen.add(step)
    assert {s for first, last in ranges for s in range(first, last + 1)} == seen
    assert all(left[1] + 1 < right[0] for left, right in pairwise(ranges))


@st.composite
def episodes(draw):
    """Lengths and ends of an actor's episodes, and which of its steps arrive how often."""
    lengths = draw(st.lists(st.integers(1, 8), min_size=1, max_size=5))
    ends = draw(st.lists(st.sampled_from(["terminated", "truncated"]), min_size=len(lengths), max_size=len(lengths)))
    copies = draw(st.lists(st.integers(0, 2), min_size=sum(lengths), max_size=sum(lengths)))
    moves = []
    for episode, (length, end) in enumerate(zip(lengths, ends, strict=True)):
        for step in range(length):
            last = step == length - 1
            reward = float(draw(st.integers(-5, 5)))
            moves.append(move(episode, step, reward, last and end == "terminated", last and end == "truncated"))
    return moves, copies


@given(episodes(), st.randoms(use_true_random=False))
def test_ledger_counts_duplicates_and_gaps_in_any_order(drawn, random):
    moves, copies = drawn
    ledger = StepLedger()
    assert ledger.join("a", 0, 0) == 0
    sent = [(index, m) for index, (m, times) in enumerate(zip(moves, copies, strict=True), 1) for _ in range(times)]
    random.shuffle(sent)
    news = [ledger.record("a", m.episode, m.step, index) for index, m in sent]
    arrived = [index for index, times in enumerate(copies, start=1) if times]
    assert sum(news) == ledger.received == len(arrived)
    assert ledger.duplicates == sum(copies) - len(arrived)
    assert ledger.missing == max(arrived, default=0) - len(arrived)
    assert ledger.places["a"].last_index == max(arrived, default=0)


def test_ledger_over_restarts():
    ledger = StepLedger()
    ledger.join("a", 0, 0)
    for step in range(5):
        ledger.record("a", 0, step, step + 1)
    again = StepLedger()
    again.restore(ledger.state())
    assert again.join("a", 8, 2) == 2  # the actor lived on: 3 steps went past a dead learner
    assert again.missing == 3
    assert ledger.join("a", 0, 0) == 1  # the actor was restarted: a new episode, its index from 0
    assert not ledger.record("a", 0, 4, 5)
    assert ledger.record("a", 0, 5, 6)  # one that was on its way; its index is of the actor before
    assert ledger.record("a", 1, 0, 1)
    assert (ledger.missing, ledger.places["a"].last_index) == (0, 1)
    assert [one.steps_of("a") for one in (ledger, again)] == [7, 5] and ledger.steps_of("b") == 0


def expected_transitions(arrived: list[ActorStep], n: int) -> list[Transition]:
    """By definition: from every step as far as n, its episode and the unbroken sequence reach."""
    by_name = {(m.episode, m.step): m for m in arrived}
    drawn = []
    for m in arrived:
        window = [m]
        while len(window) < n and not (window[-1].terminated or window[-1].truncated):
            after = by_name.get((m.episode, window[-1].step + 1))
            if after is None:
                break
            window.append(after)
        reward = sum(GAMMA**j * w.reward for j, w in enumerate(window))
        discount = 0.0 if window[-1].terminated else GAMMA ** len(window)
        drawn.append(Transition(m.observation, m.action, reward, discount, window[-1].next_observation))
    return drawn


def comparable(transitions: list[Transition]) -> list[tuple]:
    return sorted((*t.observation, round(t.reward, 9), round(t.discount, 12), *t.next_observation) for t in transitions)


@given(episodes(), st.integers(1, 4), st.booleans())
def test_windows_against_their_definition(drawn, n, checkpointed):
    moves, copies = drawn
    windows, got = NStepWindows(n, GAMMA), []
    arrived = [m for m, times in zip(moves, copies, strict=True) if times]
    for m in arrived:
        if checkpointed:
            state, windows = windows.state(), NStepWindows(n, GAMMA)
            windows.restore(state)
        got += windows.push("a", m)
    # The open windows close before the next episode.
    got += windows.push("a", move(99, 0, 0.0, terminated=True))[:-1]
    assert comparable(got) == comparable(expected_transitions(arrived, n))


def test_actors_do_not_mix():
    windows = NStepWindows(2, GAMMA)
    assert windows.push("a", move(0, 0, 1.0)) == []
    assert windows.push("b", move(0, 1, 9.0)) == []
    (transition,) = windows.push("a", move(0, 1, 1.0))
    assert transition.reward == pytest.approx(1.0 + GAMMA)


def test_the_cost_of_a_window_is_discounted_like_its_reward():
    windows = NStepWindows(3, GAMMA)
    moves = [move(0, 0, 1.0), move(0, 1, 1.0), move(0, 2, 1.0, terminated=True)._replace(collision=True)]
    closed = [transition for each in moves for transition in windows.push("a", each)]
    assert [transition.cost for transition in closed] == pytest.approx([0.81, 0.9, 1.0])


@pytest.mark.parametrize("stored", ["executed", "both"])
def test_only_what_the_filter_executed_in_place_of_a_proposal_is_imitated(stored):
    """A proposal that the vehicle's slew limits differs from what was executed, but it has no penalty."""
    other = np.full_like(move(0, 0, 1.0).action, 0.5)
    corrected = move(0, 0, 1.0)._replace(proposed=other, penalty=2.0)
    limited = move(0, 1, 1.0)._replace(proposed=other)
    windows = NStepWindows(1, GAMMA, stored)
    closed = [transition for each in (corrected, limited) for transition in windows.push("a", each)]
    imitated = [transition.action for transition in closed if transition.imitated]
    assert len(imitated) == 1 and np.array_equal(imitated[0], corrected.action)
    assert len(closed) == (4 if stored == "both" else 2)
    assert closed[0].penalty == (0.0 if stored == "both" else 2.0)


def test_a_straggler_stands_for_itself():
    windows = NStepWindows(3, GAMMA)
    closed = [t for number in (0, 2, 1) for t in windows.push("a", move(0, number, 1.0 + number))]
    assert [(t.reward, t.discount) for t in closed] == [(1.0, GAMMA), (2.0, GAMMA)]


def transition(number: float) -> Transition:
    seen, action = np.full(3, number, np.float32), np.full(1, -number, np.float32)
    return Transition(seen, action, number, 0.5, np.ones(3, np.float32))


@given(st.integers(1, 12), st.integers(1, 40))
def test_replay_holds_the_newest_also_when_restored(capacity, count):
    replay, restored, batch = ReplayBuffer(capacity, 3, 1), ReplayBuffer(capacity, 3, 1), Batch(256, 3, 1)
    for number in range(count - 1):
        replay.insert(transition(number))
    restored.restore(replay.state())
    again = Batch(256, 3, 1)
    for buffer, sampled in ((replay, batch), (restored, again)):
        buffer.insert(transition(count - 1))
        buffer.sample(np.random.default_rng(0), sampled)
    assert all((a == b).all() for a, b in zip(batch.arrays, again.arrays, strict=True))
    assert len(replay) == min(capacity, count)
    stored = set(range(max(0, count - capacity), count))
    assert set(batch.reward.flatten().tolist()) <= stored
    if len(stored) < 12:
        assert set(batch.reward.flatten().tolist()) == stored
    assert (batch.observation[0, :, :1] == batch.reward[0]).all() and (batch.action[0] == -batch.reward[0]).all()


def test_replay_of_a_checkpoint_without_penalties_and_imitation_is_restored():
    replay, restored, batch = ReplayBuffer(4, 3, 1), ReplayBuffer(4, 3, 1), Batch(2, 3, 1)
    replay.insert(transition(1.0)._replace(imitated=1.0, penalty=1.0))
    tensors = {name: array for name, array in replay.state().tensors.items() if name not in ("penalty", "imitated")}
    restored.restore(PartState(tensors, replay.state().values))
    restored.sample(np.random.default_rng(0), batch)
    assert (batch.reward == 1.0).all() and not batch.imitated.any() and not batch.penalty.any()


def test_replay_refuses_what_does_not_fit():
    replay = ReplayBuffer(4, 3, 1)
    replay.insert(transition(1.0))
    state = replay.state()
    without = PartState({name: array for name, array in state.tensors.items() if name != "action"}, state.values)
    other_next = PartState(state.tensors, state.values | {"next": 3})
    for sizes, saved, what in (
        ((5, 3, 1), state, "capacity"),
        ((4, 2, 1), state, "observation"),
        ((4, 3, 1), without, "action: missing"),
        ((4, 3, 1), other_next, "next"),
    ):
        with pytest.raises(ValueError, match=what):
            ReplayBuffer(*sizes).restore(saved)
    with pytest.raises(ValueError, match="nothing"):
        ReplayBuffer(4, 3, 1).sample(np.random.default_rng(0), Batch(2, 3, 1))


def test_a_corrected_step_is_two_lessons():
    """What was executed would have cost nothing; what was proposed cost the penalty; later penalties are on both."""
    ends = [np.array([v], np.float32) for v in (0.0, 1.0)]
    moves = [ActorStep(0, i, ends[0], ends[0], ends[1], 1.0, 0.25, ends[1], False, i == 1) for i in range(2)]
    windows = NStepWindows(2, 0.5, "both")
    first = windows.push("a", moves[0]) + windows.push("a", moves[1])
    assert [(*t.action, t.reward - t.penalty) for t in first] == [(0.0, 1.375), (1.0, 1.125), (0.0, 1.0), (1.0, 0.75)]
    single = NStepWindows(1, 0.5, "executed").push("a", moves[0])
    assert [(t.action[0], t.reward - t.penalty) for t in single] == [(0.0, 0.75)]


LOWEST = -100.0


def cut_move(step: int, cut: bool = False, terminated: bool = False) -> ActorStep:
    here, after = np.array([step], np.float32), np.array([step + 1], np.float32)
    action, proposed = np.array([0.0 if cut else 0.5], np.float32), np.array([0.5], np.float32)
    return ActorStep(0, step, here, action, proposed, 1.0, 1.0 - LOWEST if cut else 0.0, after, terminated, False, cut)


# Observation, action, reward, discount, next observation.
PROPOSED = (2, 0.5, LOWEST, 0.0, 3)
BEFORE = [(0, 0.5, round(1.9 + 0.81 * LOWEST, 6), 0.0, 3), (1, 0.5, round(1 + 0.9 * LOWEST, 6), 0.0, 3)]
AFTER = [(3, 0.5, 2.71, 0.729, 6), (4, 0.5, 2.71, 0.729, 7)]


@pytest.mark.parametrize(
    ("stored", "terminated", "steps", "expected"),
    [
        ("executed", False, 5, [*BEFORE, PROPOSED]),  # steps 3 and 4 are still open
        ("executed", False, 7, [*BEFORE, PROPOSED, *AFTER]),
        ("both", False, 5, [*BEFORE, (2, 0.0, 1.0, GAMMA, 3), PROPOSED]),  # the backup policy's action has a value
        ("both", True, 3, [*BEFORE, (2, 0.0, 1.0, 0.0, 3), PROPOSED]),
    ],
)
def test_a_cut_ends_the_episode_for_the_learner_with_the_lowest_reward(stored, terminated, steps, expected):
    windows = NStepWindows(3, GAMMA, stored)
    transitions = [t for k in range(steps) for t in windows.push("a", cut_move(k, k == 2, terminated and k == 2))]
    sampled = [
        (*t.observation, *t.action, round(t.reward - t.penalty, 6), round(t.discount, 6), *t.next_observation)
        for t in transitions
    ]
    assert sampled == expected


def may_insert(limiter: RateLimiter) -> bool:
    return limiter.error + limiter.samples_per_insert < limiter.ceiling


@given(
    st.lists(st.booleans(), max_size=300),
    st.sampled_from([0.5, 1.0, 4.0, 8.0, 16.0, 64.0]),
    st.integers(0, 20),
    st.sampled_from([0.0, 1.0, 5.0]),
)
def test_error_stays_in_its_band_and_room_is_the_number_of_inserts_allowed_in_a_row(wishes, ratio, warmup, ahead):
    limiter = RateLimiter(ratio, batch=8, warmup=warmup, ahead=ahead)
    for wants_insert in wishes:
        assert may_insert(limiter) or limiter.may_sample()
        if wants_insert and may_insert(limiter):
            limiter.insert()
        elif limiter.may_sample():
            assert limiter.inserts >= warmup
            limiter.sample()
        assert limiter.error < limiter.ceiling
        assert limiter.error >= (0.0 if limiter.samples else -ratio * warmup)
    room, allowed = limiter.room(), 0
    while may_insert(limiter):
        limiter.insert()
        allowed += 1
    assert room == allowed


@pytest.mark.parametrize("updates_per_step", [0.25, 0.5, 1.0, 2.0, 3.0])
def test_lockstep_alternates_and_owes_nothing_for_the_warmup(updates_per_step):
    limiter = RateLimiter(updates_per_step * 8, batch=8, warmup=10)
    for step in range(1, 101):
        assert may_insert(limiter) and not limiter.may_sample()
        limiter.insert()
        while limiter.may_sample():
            assert not may_insert(limiter)
            limiter.sample()
        assert limiter.samples // 8 == int(max(0, step - 10) * updates_per_step)
