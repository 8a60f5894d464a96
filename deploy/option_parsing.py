"""How the command line reads and shows options that need no value.

tyro shows `X | None` as `{None}|X`, takes the word None, and names Python's NoneType if it can't parse a value. An
option that is left out is None already, so that only X is shown and parsed.
"""

from __future__ import annotations

from dataclasses import replace
from types import NoneType
from typing import Any, get_args

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

registry = ConstructorRegistry()


@registry.primitive_rule
def _optional_value(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    kinds = get_args(info.type)
    if NoneType not in kinds or len(kinds) != 2:
        return None
    (kind,) = (kind for kind in kinds if kind is not NoneType)
    spec = registry.get_primitive_spec(PrimitiveTypeInfo.make(kind, parent_markers=info.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["none"] if value is None else spec.str_from_instance(value),
    )
