"""Griffe extension: the comment behind a dataclass field, where its unit stands, becomes its documentation.

The reference would otherwise list the options of a stage without saying what they mean. The comments stay the
only place that says it.
"""

from __future__ import annotations

import io
import tokenize
from typing import Any

import griffe

__all__ = ["FieldComments"]


class FieldComments(griffe.Extension):
    """Give undocumented attributes of classes the comment that ends their line."""

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """Document the fields of one class."""
        if not any("dataclass" in str(decorator.value) for decorator in cls.decorators):
            return
        comments = _comments("\n".join(cls.lines_collection[cls.filepath]))
        for attribute in cls.attributes.values():
            comment = comments.get(attribute.endlineno or 0)
            if attribute.docstring is None and comment:
                attribute.docstring = griffe.Docstring(comment, parent=attribute)


def _comments(source: str) -> dict[int, str]:
    """Return the comments of a module by their line."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
