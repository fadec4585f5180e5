"""A table whose rows are read when needed: for Arrow, pandas, or as a stream."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rsltrace.errors import SetupError

Makers = Callable[[Any], tuple[Any, Iterator[Any]]]
"""Given pyarrow, returns the schema of a table and its rows as record batches."""


class TraceTable:
    """A table of a trace. Each use reads the trace again, which must still be open.

    Libraries with Arrow's PyCapsule interface accept it: ``polars.DataFrame(table)``.
    """

    def __init__(self, make: Makers) -> None:
        self._make = make

    def to_arrow(self) -> Any:
        """Return a ``pyarrow.Table`` with one chunk per segment.

        Each column is copied once. Raises SetupError without pyarrow, TraceError where the trace is
        damaged.
        """
        arrow = _arrow()
        schema, batches = self._make(arrow)
        return arrow.Table.from_batches(list(batches), schema)

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``: integers stay integers, also beside nulls; texts are
        categories. Raises SetupError without pandas or pyarrow."""
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
        # pandas converts integers beside nulls to floats, which rounds hashes.
        columns = {
            name: table[name].to_pandas(
                types_mapper=numbers.get if table[name].null_count else None
            )
            for name in table.column_names
        }
        return pandas.DataFrame(columns, copy=False)

    def to_reader(self) -> Any:
        """Return a ``pyarrow.RecordBatchReader``, which reads one segment at a time."""
        arrow = _arrow()
        return arrow.RecordBatchReader.from_batches(*self._make(arrow))

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Pass the rows to another library as a stream."""
        return self.to_reader().__arrow_c_stream__(requested_schema)


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise _missing("pyarrow") from None
    return pyarrow


def _missing(package: str) -> SetupError:
    return SetupError(f"tables need {package}: pip install 'rsltrace[tables]'")
