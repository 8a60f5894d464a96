import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.learner.rate_limiter import RateLimiter


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
