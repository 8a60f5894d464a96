"""How many samples an insert is worth: the rate limiter of Reverb (Cassirer et al. 2021)."""

from __future__ import annotations

import math

from brakeline.learner.checkpoint_state import PartState


class RateLimiter:
    """Keeps learning and acting in step:

        error = (inserts − warmup) · samples_per_insert − samples,    0 ≤ error < ceiling  (below 0 in the warm-up)

    Sampling would lower the error, inserting would raise it; each is allowed while the band holds. The ceiling is at
    least a batch and an insert, or neither could move. The first `warmup` inserts are owed no samples, and there is no
    sampling before them.
    """

    def __init__(self, samples_per_insert: float, batch: int, warmup: int, ahead: float = 0.0) -> None:
        """`ahead`: inserts that actors may be ahead of the learner; 0 is lockstep."""
        self.samples_per_insert, self.batch, self.warmup = samples_per_insert, batch, warmup
        self.ceiling = batch + samples_per_insert * (1.0 + ahead)
        self.inserts = 0
        self.samples = 0

    @property
    def error(self) -> float:
        return (self.inserts - self.warmup) * self.samples_per_insert - self.samples

    @property
    def warming_up(self) -> bool:
        return self.inserts < self.warmup

    def may_sample(self) -> bool:
        """Is a whole batch due?"""
        return not self.warming_up and self.error >= self.batch

    def may_insert(self) -> bool:
        return self.error + self.samples_per_insert < self.ceiling

    def room(self) -> int:
        """How many inserts in a row are allowed now."""
        return max(0, math.ceil((self.ceiling - self.error) / self.samples_per_insert) - 1)

    def insert(self) -> None:
        self.inserts += 1

    def sample(self) -> None:
        self.samples += self.batch

    def state(self) -> PartState:
        return PartState({}, {"inserts": self.inserts, "samples": self.samples})

    def restore(self, state: PartState) -> None:
        self.inserts, self.samples = state.integer("inserts"), state.integer("samples")
