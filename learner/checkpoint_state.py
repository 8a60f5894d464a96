"""What a part of the learner leaves in a checkpoint, and takes back from it only if every piece fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadState


@dataclass(frozen=True)
class PartState:
    """Arrays (they rest as safetensors) and plain values (they rest as JSON)."""

    tensors: dict[str, NDArray[Any]]
    values: dict[str, Any]

    def tensor(self, name: str, shape: tuple[int | None, ...], dtype: str) -> NDArray[Any]:
        """The array of that name; None in `shape` allows any length."""
        if name not in self.tensors:
            raise BadState(f"{name}: missing")
        array = self.tensors[name]
        fits = len(array.shape) == len(shape) and all(
            want is None or have == want for have, want in zip(array.shape, shape, strict=True)
        )
        if not fits or array.dtype != np.dtype(dtype):
            raise BadState(f"{name}: {array.dtype} {array.shape} where {dtype} {shape} belongs")
        return array

    def integer(self, name: str) -> int:
        value = self.value(name)
        if type(value) is not int:
            raise BadState(f"{name}: {value!r} is not an integer")
        return value

    def value(self, name: str) -> Any:
        if name not in self.values:
            raise BadState(f"{name}: missing")
        return self.values[name]
