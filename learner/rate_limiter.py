"""Hold the ratio of samples to inserts: the rate limiter of Reverb (Cassirer et al. 2021)."""

from __future__ import annotations

import math

from brakeline.learner.checkpoint import PartState


class RateLimiter:
    """Keep the error between inserts and samples in a band.

        error = (inserts − warmup) · samples_per_insert − samples,    0 ≤ error < ceiling  (below 0 in the warm-up)

    Sampling lowers the error, and inserting raises it. Each is allowed as long as the error stays in the band. The
    ceiling is at least the size of a batch and the error of one insert, so that one of them is always allowed. Sampling
    starts after `warmup` inserts.
    """

    def __init__(self, samples_per_insert: float, batch: int, warmup: int, ahead: float = 0.0) -> None:
        """Start without inserts. ahead: by how many inserts actors may be ahead of the learner; 0: lockstep."""
        self.samples_per_insert, self.batch, self.warmup = samples_per_insert, batch, warmup
        self.ceiling = batch + samples_per_insert * (1.0 + ahead)
        self.inserts = 0
        self.samples = 0

    @property
    def error(self) -> float:
        return (self.inserts - self.warmup) * self.samples_per_insert - self.samples

    @property
    def warming_up(self) -> bool:
        """Whether sampling has not started."""
        return self.inserts < self.warmup

    def may_sample(self) -> bool:
        """Return whether a whole batch is due."""
        return not self.warming_up and self.error >= self.batch

    def room(self) -> int:
        """Return how many inserts in a row are allowed now."""
        return max(0, math.ceil((self.ceiling - self.error) / self.samples_per_insert) - 1)

    def insert(self) -> None:
        self.inserts += 1

    def sample(self) -> None:
        self.samples += self.batch

    def state(self) -> PartState:
        return PartState({}, {"inserts": self.inserts, "samples": self.samples})

    def restore(self, state: PartState) -> None:
        """Take over the state of a checkpoint."""
        self.inserts, self.samples = state.integer("inserts"), state.integer("samples")
