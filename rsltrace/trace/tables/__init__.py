"""A trace as tables for Arrow and pandas: events, outputs, entities and messages.

Reading a trace does not need this; pyarrow and pandas are imported when a table is used (``pip
install 'rsltrace[tables]'``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rsltrace.trace.tables.rows import (
    TableInput,
    TraceTable,
    entity_table,
    event_table,
    output_table,
)

if TYPE_CHECKING:
    from rsltrace.trace.decode import Decoder
    from rsltrace.trace.index import ChannelInfo

__all__ = ["TraceTable", "TraceTables"]


class TraceTables:
    """The tables of a trace. Rows are read only when needed.

    Times are simulated nanoseconds, hashes unsigned 64-bit integers; missing values (the cause of a
    timer's event) are null.
    """

    def __init__(self, trace: TableInput, decoder: Callable[[ChannelInfo], Decoder]) -> None:
        self._trace = trace
        self._decoder = decoder

    def events(self, first: int = 0, last: int | None = None) -> TraceTable:
        """Return the events ``first <= index < last``, a row each."""
        return event_table(self._trace, first, last)

    def outputs(self, first: int = 0, last: int | None = None) -> TraceTable:
        """Return the outputs of the events ``first <= index < last``, a row each."""
        return output_table(self._trace, first, last)

    def entities(self) -> TraceTable:
        """Return nodes, publishers, timers and all other entities."""
        return entity_table(self._trace)

    def messages(
        self, topic: str, fields: Sequence[str] | None = None, *, type: str | None = None
    ) -> TraceTable:
        """Return the recorded messages on ``topic``, decoded, one row each, in file order.

        ``fields`` names the columns, nested ones with dots (``pose.pose.position.x``); a message
        field stands for everything in it, None for the whole message. ``type`` is needed for topics
        with several types. Raises TraceError for an unknown topic or field; the table raises it for
        a message that does not fit its type.
        """
        from rsltrace.trace.tables.messages import message_table

        return message_table(self._trace, self._decoder, topic, fields, type)
