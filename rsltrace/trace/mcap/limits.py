"""How much of anything is read from a file or a server before it is refused.

What is in a file was written by anybody. These limits hold for traces and for bags; they are far
above what either has, and keep memory and time within what the file is asked for.
``docs/trace-format.md`` states them for people.
"""

from __future__ import annotations

MESSAGE_BYTES_MAX = 512 << 20
"""The largest message that is recorded in a trace, and taken from a bag."""

CHUNK_BYTES_MAX = MESSAGE_BYTES_MAX + (1 << 20)
"""What a chunk may unpack to: one such message, and what was gathered before it."""

RECORD_BYTES_MAX = CHUNK_BYTES_MAX + (1 << 20)
"""The largest record that is read at once, as it stands in the file."""

SUMMARY_BYTES_MAX = 256 << 20
"""The summary of a trace of a thousand million events has a quarter of this."""

ENTITY_ID_MAX = 1 << 24
"""Ids count up, but not all that have one are in the trace. A diff makes a table by id."""

FILE_GROWTH_MAX = 1000
FILE_BYTES_MIN = 1 << 30
"""A compressed bag file may unpack to so many times its size, and always to so much."""

METADATA_YAML_BYTES_MAX = 4 << 20
"""Some 4000 topics and their QoS; parsing takes 60 times as much memory, and 3 µs per byte."""

SCHEMA_BYTES_MAX = 256 << 10
"""Of one type with all it depends on; parsing takes some 8 µs per character."""

SCHEMAS_BYTES_MAX = 4 << 20
"""Of all types that are decoded of one trace."""

SCHEMA_ITEMS_MAX = 4096
SCHEMAS_ITEMS_MAX = 16384
"""Items of all fixed arrays of strings or messages, in a schema and in all that are decoded of one
trace: each becomes lines of code, and a thousand of them take a second."""

RESPONSE_BYTES_MAX = 64 << 20
"""A server may know no ranges and send all; what is larger has to be downloaded by its owner."""

REQUEST_SECONDS_MAX = 60.0
"""For one request to a server, however it spends them."""

REMOTE_SECONDS_MAX = 600.0
"""For all requests of one open file together."""
