"""The state of one part of the learner in a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PartState:
    """Arrays (stored as safetensors) and plain values (stored as JSON). Its methods raise ValueError."""

    tensors: dict[str, NDArray[Any]]
    values: dict[str, Any]

    def tensor(self, name: str, shape: tuple[int | None, ...], dtype: str) -> NDArray[Any]:
        """Return an array after a check of its shape (None: any length) and type."""
        if name not in self.tensors:
            raise ValueError(f"{name}: missing")
        array = self.tensors[name]
        fits = array.ndim == len(shape) and all(
            want in (None, have) for have, want in zip(array.shape, shape, strict=True)
        )
        if not fits or array.dtype != np.dtype(dtype):
            raise ValueError(f"{name}: {array.dtype} {array.shape}, not {dtype} {shape}")
        return array

    def integer(self, name: str) -> int:
        """Return a value after a check that it is an integer."""
        value = self.value(name)
        if type(value) is not int:
            raise ValueError(f"{name}: {value!r} is not an integer")
        return value

    def value(self, name: str) -> Any:
        """Return a value."""
        if name not in self.values:
            raise ValueError(f"{name}: missing")
        return self.values[name]
