"""(being written) field by field: see the interface in the docstrings."""

from __future__ import annotations

from rsltrace.diff.model import FieldDifference
from rsltrace.diff.options import DiffOptions


def diff_messages(
    a: object, b: object, options: DiffOptions, *, limit: int = 20
) -> tuple[tuple[FieldDifference, ...], int]:
    raise NotImplementedError


def preview(message: object, width: int = 100) -> str:
    raise NotImplementedError
