"""The faults of one table of fleet data: told in the words of its author, with the rows that can be left out."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

__all__ = ["TableChecks", "TableOrigin", "few", "may_leave_out"]

_SHARE_LEFT_OUT = 0.05  # of the rows of a file that may be left out unasked
_EXAMPLES_SHOWN = 3  # offending rows named in a fault
_LONGEST_VALUE = 40  # characters of a value that a message shows


@dataclass(frozen=True)
class TableOrigin:
    """Where a table came from, in the words of its author, for messages."""

    name: str = "traces"  # what is in the table
    row_word: str = "row"  # "line" for text files
    first_row: int = 0  # number of the table's first row in those words
    columns: Mapping[str, str] = field(default_factory=dict)  # our column name -> the author's
    by_name: Collection[str] = ()  # our columns that were taken for their usual names alone, not named by the user

    def column(self, ours: str) -> str:
        """Return the name of one of our columns for a message."""
        theirs = self.columns.get(ours, ours)
        return repr(ours) if theirs == ours else f"{theirs!r} ({ours})"

    def rows(self, mask: NDArray[np.bool_], values: Any) -> str:
        """Return as text how many rows a mask selects, and the first few of them."""
        rows = np.flatnonzero(mask)
        values = np.asarray(pd.Series(values).iloc[rows[:_EXAMPLES_SHOWN]])
        shown = ", ".join(
            f"{self.row_word} {row + self.first_row}: {_brief(value)}" for row, value in zip(rows, values, strict=False)
        )
        return f"{len(rows)} of {len(mask)} rows ({shown}{', ...' if len(rows) > _EXAMPLES_SHOWN else ''})"


class TableChecks:
    """The faults found in one table: those of the whole table, and rows that can be left out."""

    def __init__(self, origin: TableOrigin, faults: list[str]) -> None:
        self.origin, self.faults = origin, faults
        self.rows: list[tuple[str, NDArray[np.bool_]]] = []

    def name(self, ours: str) -> str:
        """Return the name of a column for the start of a fault."""
        return f"{self.origin.name}: column {self.origin.column(ours)}"

    def fault(self, fault: str) -> None:
        """Add a fault of the table."""
        self.faults.append(fault)

    def row_fault(self, fault: str, mask: NDArray[np.bool_]) -> None:
        """Add a fault of some rows."""
        self.rows.append((fault, mask))


def may_leave_out(n_bad: int, n_rows: int, invalid: str | None) -> bool:
    """Tell whether bad rows are left out: ``"drop"``, ``"refuse"``, or None for up to 5 % of them.

    Examples
    --------
    >>> may_leave_out(5, 100, None), may_leave_out(6, 100, None), may_leave_out(6, 100, "drop")
    (True, False, True)
    """
    return invalid == "drop" or (invalid is None and n_bad <= _SHARE_LEFT_OUT * n_rows)


def few(values: Any) -> str:
    """Return the first few values as text.

    Examples
    --------
    >>> few(range(5))
    '0, 1, 2, ...'
    """
    values = list(values)
    return ", ".join(map(_brief, values[:_EXAMPLES_SHOWN])) + (", ..." if len(values) > _EXAMPLES_SHOWN else "")


def _brief(value: Any) -> str:
    """Return a value as text for a message, shortened if it is long."""
    text = str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."
