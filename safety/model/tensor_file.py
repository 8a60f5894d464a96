"""Store named arrays and their metadata as a safetensors file, which cannot contain code.

All metadata are in one entry, as JSON with sorted keys. The order of several entries would vary from file to file,
but the same content must give the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from brakeline.errors import BadTensors
from brakeline.messaging.structured_text import parse_json


def pack(tensors: Mapping[str, NDArray[Any]], entry: str, about: Mapping[str, Any]) -> bytes:
    """Return the bytes of a safetensors file.

    Args:
        tensors: arrays by name, of any shape.
        entry: name of the metadata entry.
        about: the metadata; JSON must be able to represent it.
    """
    return save(_contiguous(tensors), {entry: json.dumps(about, sort_keys=True)})


def content(tensors: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the arrays as bytes without metadata, as input to a hash."""
    return save(_contiguous(tensors))


def unpack(payload: bytes, entry: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays and the metadata of a safetensors file.

    Args:
        payload: the file's bytes.
        entry: name of the metadata entry.

    Returns:
        The arrays by name, and the content of the metadata entry.

    Raises:
        BadTensors: the bytes are no safetensors file, or the entry is missing or no JSON object.
    """
    try:
        about = parse_json(_metadata(payload)[entry])
        tensors = load(payload)
    except KeyError as error:
        raise BadTensors(f"there is no {error} in it") from error
    except (SafetensorError, ValueError, TypeError, AttributeError) as error:
        raise BadTensors(str(error)) from error
    if not isinstance(about, dict):
        raise BadTensors(f"its {entry!r} is no object")
    return tensors, about


def has_entry(payload: bytes, entry: str) -> bool:
    """Return whether `payload` is a safetensors file with this metadata entry."""
    try:
        return entry in _metadata(payload)
    except (ValueError, TypeError, AttributeError):
        return False


def _contiguous(tensors: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}


def _metadata(payload: bytes) -> dict[str, str]:
    size = int.from_bytes(payload[:8], "little")
    metadata: dict[str, str] = parse_json(payload[8 : 8 + size]).get("__metadata__", {})
    return metadata
