"""Parse JSON and TOML from files and messages, which may be damaged or hostile."""

from __future__ import annotations

import json
import tomllib
from typing import Any

from brakeline.errors import BadText

TOML_ENCODING = "utf-8-sig"  # UTF-8 in every locale, also with the mark that editors of Windows write at the start


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text. Raises BadText: the text is not JSON, or nested too deeply."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadText(f"not JSON: {error}") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Return the values of a TOML text. Raises BadText: the text is not TOML, or nested too deeply."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadText(f"not TOML: {error}") from error
