"""A short fuzz of every log format; the long one is `python -m tests.fuzz.log_fuzz FOLDER`."""

import gc
from pathlib import Path
from random import Random

import pytest

from tests.fuzz.log_fuzz import LIMITED, READ, REFUSED, outcome
from tests.fuzz.log_seeds import SEEDS, seed
from tests.fuzz.mutations import mutated

FILES = 12  # of each format


@pytest.mark.filterwarnings("ignore")  # extreme numbers overflow, and parsers leave files open
@pytest.mark.parametrize("kind", SEEDS)
def test_a_mutated_log_is_read_or_refused_with_an_error_of_ours(kind: str, tmp_path: Path) -> None:
    path = seed(kind, tmp_path)
    assert outcome(path) == READ
    target = path.with_stem("mutated")
    for number in range(FILES):
        target.write_bytes(mutated(path.read_bytes(), Random(f"{kind} {number}")))
        assert outcome(target) in (READ, REFUSED, LIMITED), number
    gc.collect()  # else the files that a parser left open are closed, with a warning, in whatever test comes next
