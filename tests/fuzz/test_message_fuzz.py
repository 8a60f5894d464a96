"""A short fuzz of every process that listens; the long one is `python -m benchmarks fuzz`."""

from tests.fuzz.message_fuzz import fuzz


def test_no_message_ends_a_process_and_a_report_of_them_can_be_read() -> None:
    rows = fuzz(2200, seed=7)
    assert rows["all"]["crashes"] == 0, [name for name in rows if ": " in name]
    for name in ("launcher", "recorder", "watch", "learner", "actor", "safety", "asker", "analyse"):
        assert rows[name]["messages"] > 100, name
    for name in ("launcher", "recorder", "watch", "learner"):
        assert 0 < rows[name]["passed over"] < rows[name]["messages"], f"{name}: some are handled, some are not"
