"""A short fuzz of every process that listens; the long one is `python -m benchmarks fuzz`."""

from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brakeline.messaging.topics import TOPICS
from tests.fuzz.message_fuzz import Party, fuzz, parties
from tests.fuzz.message_fuzzer import MessageFuzzer


def test_no_message_ends_a_process_and_a_report_of_them_can_be_read() -> None:
    rows = fuzz(2000, seed=7)
    assert rows["all"]["crashes"] == 0, [name for name in rows if ": " in name]
    for name in ("launcher", "recorder", "watch", "learner", "actor", "safety", "asker", "analyse"):
        assert rows[name]["messages"] > 100, name
    for name in ("launcher", "recorder", "watch", "learner"):
        assert 0 < rows[name]["passed over"] < rows[name]["messages"], f"{name}: some are handled, some are not"


@pytest.fixture(scope="module")
def everybody(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Party]]:
    everybody = parties(tmp_path_factory.mktemp("fuzz"), MessageFuzzer(0))
    yield everybody
    for party in everybody.values():
        party.close()


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(topic=st.sampled_from(TOPICS), seed=st.integers(0, 2**32), cut=st.binary(max_size=8))
def test_whatever_is_sent_is_handled_or_passed_over(
    everybody: dict[str, Party], fuzzer: MessageFuzzer, topic, seed: int, cut: bytes
) -> None:
    """Hypothesis finds the smallest message that ends a process."""
    fuzzer.random.seed(seed)
    sample = fuzzer.sample(topic)
    for other in (sample, type(sample)(topic, sample.key, sample.payload + cut, sample.received)):
        for party in everybody.values():
            if topic.name in party.names:
                party.take(other)
                party.look()


@pytest.fixture(scope="module")
def fuzzer() -> MessageFuzzer:
    return MessageFuzzer(1)
