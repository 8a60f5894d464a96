"""Test a replay with sums in another order: the same kinds, and numbers equal to within rounding."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.run.replay_run import differences
from brakeline.logs.reader import open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.wire import decision_reply, request_of
from tests.robots import GROUND

LINE = 64  # bytes: the widest vector that a processor loads at once


def test_with_another_processors_linear_algebra_no_decision_differs(log: Path) -> None:
    """The kernels of a processor without wide vectors, where there is a choice (x86), add in another order."""
    words = (sys.executable, "-m", "brakeline.deploy.cli", "replay", str(log), "--json")
    done = subprocess.run(
        words, env=os.environ | {"OPENBLAS_CORETYPE": "Prescott"}, capture_output=True, text=True, check=False
    )
    figures = json.loads(done.stdout)
    assert (done.returncode, figures["different"]) == (0, 0), figures
    assert figures["identical"] + figures["equal"] == figures["requests"] > 0
    assert figures["rounding"] < 1e-12


def moved(array: Any, offset: int) -> Any:
    """A copy of an array that begins so many bytes after a cache line, as a view into a larger buffer."""
    buffer = np.empty(array.nbytes + 2 * LINE, np.uint8)
    start = -buffer.ctypes.data % LINE + offset
    view = buffer[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    view[...] = array
    return view


def owners(thing: object, seen: set[int]) -> Iterator[dict[str, Any]]:
    """The attributes of an object of ours and of all that it holds."""
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, tuple | list):
        for part in thing:
            yield from owners(part, seen)
    elif type(thing).__module__.startswith("brakeline.safety") and hasattr(thing, "__dict__"):
        yield vars(thing)
        for part in list(vars(thing).values()):
            yield from owners(part, seen)


def move_arrays(thing: object, offset: int) -> int:
    """Move every array of floats that an object holds; how many there were."""

    def one(value: Any) -> Any:
        nonlocal count
        if isinstance(value, np.ndarray) and value.dtype == float and value.size and value.flags.c_contiguous:
            count += 1
            return moved(value, offset)
        return tuple(map(one, value)) if type(value) is tuple else value

    count = 0
    for attributes in owners(thing, set()):
        attributes.update({name: one(value) for name, value in attributes.items()})
    return count


@pytest.mark.parametrize("offset", range(8, LINE, 8))
def test_with_another_alignment_of_arrays_no_decision_differs(log: Path, offset: int) -> None:
    ready, elsewhere = (Filter(model_for(GROUND, ModelConfig())) for _ in range(2))
    assert move_arrays(elsewhere, offset) > 30
    assert elsewhere.tube.W.ctypes.data % LINE == offset
    kinds = set()
    for record in open_log(log):
        if record.topic != "exchange":
            continue
        one, other = (request_of(record.message.request, GROUND) for _ in range(2))
        for name in ("state", "action", "input_in_force", "plan"):
            object.__setattr__(other, name, moved(getattr(other, name), offset))
        reply, again = decision_reply(ready.decide(one), 0.0), decision_reply(elsewhere.decide(other), 0.0)
        kinds.add(pb.Kind.Name(reply.decision.kind))
        different = differences(reply, again, GROUND.action_dim)
        assert all(difference.rounding for difference in different.values()), different
    assert kinds >= {"ALLOWED", "ADJUSTED"}
