"""A trace as tables: its events, outputs, entities and messages, for Arrow, pandas and the like.

Nothing here is needed to read a trace; pyarrow and pandas are loaded when a table is made of one
(``pip install 'rsltrace[tables]'``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rsltrace.trace.tables.rows import Source, entity_table, event_table, output_table
from rsltrace.trace.tables.table import Table

if TYPE_CHECKING:
    from rsltrace.trace.decode import Decoder
    from rsltrace.trace.index import ChannelInfo

__all__ = ["Table", "Tables"]


class Tables:
    """The tables of a trace. Nothing is read before one is asked for its rows.

    Times are simulated nanoseconds, hashes unsigned 64-bit integers, and what there is nothing of
    (the cause of a timer's event) is null.
    """

    def __init__(self, trace: Source, decoder: Callable[[ChannelInfo], Decoder]) -> None:
        self._trace = trace
        self._decoder = decoder

    def events(self, first: int = 0, last: int | None = None) -> Table:
        """Return the events ``first <= index < last``, a row each."""
        return event_table(self._trace, first, last)

    def outputs(self, first: int = 0, last: int | None = None) -> Table:
        """Return the outputs of the events ``first <= index < last``, a row each."""
        return output_table(self._trace, first, last)

    def entities(self) -> Table:
        """Return nodes, publishers, timers and all else that events and outputs are of."""
        return entity_table(self._trace)

    def messages(
        self, topic: str, fields: Sequence[str] | None = None, *, type: str | None = None
    ) -> Table:
        """Return the recorded messages on ``topic``, a row each, in file order, decoded.

        ``fields`` names those wanted, nested ones with dots (``pose.pose.position.x``); a field
        that is a message stands for all in it, None for the whole message. ``type`` is needed where
        a topic has messages of several types. Raises TraceError for a topic or a field that is not
        there; the table raises it for a message that does not fit its type.
        """
        from rsltrace.trace.tables.messages import message_table

        return message_table(self._trace, self._decoder, topic, fields, type)
