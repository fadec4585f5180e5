"""A table whose rows are read when they are asked for: as Arrow, as pandas, or as a stream."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.errors import SetupError

Makers = Callable[[Any], tuple[Any, Iterator[Any]]]
"""Given pyarrow: the schema of a table, and its rows as record batches."""


class Table:
    """A table of a trace. Each use reads the trace again, which must still be open.

    Libraries that know Arrow's PyCapsule interface take it as it is: ``polars.DataFrame(table)``.
    """

    def __init__(self, make: Makers) -> None:
        self._make = make

    def to_arrow(self) -> Any:
        """Return a ``pyarrow.Table``, of a chunk per segment of the trace.

        A segment's rows are unpacked, and each column is copied out of them once. Raises
        SetupError if pyarrow is not installed, TraceError where the trace is damaged.
        """
        arrow = _arrow()
        schema, batches = self._make(arrow)
        return arrow.Table.from_batches(list(batches), schema)

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``: numbers as they are, also beside nulls; labels as
        categories. Raises SetupError if pandas or pyarrow is not installed."""
        arrow = _arrow()
        try:
            import pandas
        except ImportError:
            raise _missing("pandas") from None
        table = self.to_arrow()
        numbers = {
            arrow.int64(): pandas.Int64Dtype(),
            arrow.uint64(): pandas.UInt64Dtype(),
            arrow.uint32(): pandas.UInt32Dtype(),
        }
        # pandas would make floats of whole numbers beside nulls, which rounds hashes.
        columns = {
            name: table[name].to_pandas(
                types_mapper=numbers.get if table[name].null_count else None
            )
            for name in table.column_names
        }
        return pandas.DataFrame(columns, copy=False)

    def to_reader(self) -> Any:
        """Return a ``pyarrow.RecordBatchReader``, which reads a segment of the trace at a time."""
        arrow = _arrow()
        return arrow.RecordBatchReader.from_batches(*self._make(arrow))

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Give the rows to another library as a stream."""
        return self.to_reader().__arrow_c_stream__(requested_schema)


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise _missing("pyarrow") from None
    return pyarrow


def _missing(package: str) -> SetupError:
    return SetupError(f"tables need {package}: pip install 'rsltrace[tables]'")
