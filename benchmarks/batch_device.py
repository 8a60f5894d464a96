"""Time `decide_batch` on an accelerator, beside the same batch in NumPy and the loop over `decide` on one core.

The requests are those of policies behind the filter, repeated until a batch is full. The tensors stay on the device.
The time is that of the clock, until the device has finished. This needs a torch that knows the device.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter

import numpy as np
import torch

from benchmarks import batch_decide
from benchmarks.timing import Figures, spread_of
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_set import DIRECT, ONE_STEP

SIZES = (4096, 65_536, 1_048_576)  # of batches
LOOP, BLOCKS = 1024, 5  # requests of the loop


def run(device: str) -> Figures:
    """Return a row for each robot, mode, policy and size of a batch. Exits if torch cannot use the device."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch raises both
        raise SystemExit(f"torch {torch.__version__} cannot use {device!r}: {error}. Name another --device.") from error
    figures: Figures = {}
    for name in ("ground", "quadrotor"):
        for mode in (ONE_STEP, DIRECT):
            for policy in ("trained", "random"):
                safety_filter, requests = batch_decide.filter_and_requests(name, mode, policy)
                figures |= measured(f"{name}, {mode}, {policy}", safety_filter, RequestArrays.of(requests), device)
    return figures


def measured(title: str, safety_filter: Filter, requests: RequestArrays, device: str) -> Figures:
    """Return a row for each size of a batch that repeats the requests."""
    figures: Figures = {}
    few = [requests.row(row) for row in range(min(LOOP, len(requests)))]
    ours, theirs = safety_filter.decide_batch(requests), safety_filter.decide_batch(on_device(requests, device))
    apart = {
        "other kind": int((ours.kind != theirs.kind.cpu().numpy()).sum()),
        "apart": float(np.abs(ours.plan - theirs.plan.cpu().numpy()).max()),
    }
    for size in SIZES:
        arrays = on_device(requests.rows(np.resize(np.arange(len(requests)), size).tolist()), device)
        answers = safety_filter.decide_batch(arrays)
        times = []
        for _ in range(BLOCKS):
            batch = seconds(partial(safety_filter.decide_batch, arrays), device) / size
            numpy = seconds(partial(safety_filter.decide_batch, requests), "cpu") / len(requests)
            loop = seconds(lambda: [safety_filter.decide(request) for request in few], "cpu") / len(few)
            times.append((batch, numpy, loop))
        least = np.min(times, axis=0)
        figures[f"{title}: {size} on {device}"] = {
            "batch 1/s": 1.0 / least[0],
            f"numpy 1/s, {len(requests)}": 1.0 / least[1],
            "loop 1/s": 1.0 / least[2],
            **spread_of(np.array([loop / batch for batch, _, loop in times])),
            "singly %": 100.0 * len(answers.singly) / size,
            "allowed %": 100.0 * float((answers.kind == 0).sum()) / size,
            **apart,
        }
    return figures


def seconds(call: Callable[[], object], device: str) -> float:
    """Return the time of a call [s], until the device has finished."""
    before = perf_counter()
    call()
    if device != "cpu":
        torch.accelerator.synchronize()
    return perf_counter() - before


def on_device(requests: RequestArrays, device: str) -> RequestArrays:
    """Return requests whose arrays are tensors on a device."""
    return requests.mapped(lambda array: torch.from_numpy(np.ascontiguousarray(array)).to(device))
