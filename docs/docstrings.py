"""For `make docs`: examples in docstrings become code, names of pages become links, comments on fields are shown."""

from __future__ import annotations

import linecache
import re
from typing import Any

from griffe import Attribute, Docstring, Extension, Object

EXAMPLE = re.compile(r"(?m)^>>> .*(?:\n(?!\s*$).*)*")
PAGE = re.compile(r"docs/([\w-]+)\.md")


class Docstrings(Extension):
    """Change the docstrings that the reference shows."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Put each example into a fence, and link each page."""
        if obj.docstring is not None:
            text = EXAMPLE.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)
            obj.docstring.value = PAGE.sub(r"[\1](\1.html)", text)

    def on_attribute(self, *, attr: Attribute, **_: Any) -> None:
        """Take the comment on the line of a dataclass's field as its docstring."""
        if attr.docstring is None and attr.lineno and attr.parent is not None and "dataclass" in attr.parent.labels:
            _, _, comment = linecache.getline(str(attr.filepath), attr.endlineno or attr.lineno).partition("  # ")
            attr.docstring = Docstring(comment.strip(), parent=attr) if comment else None
