"""Names, layouts and limits of the trace format, described in ``docs/trace-format.md``.

A trace is a ROS 2 MCAP file. Events and outputs are CDR messages of fixed size in their own chunks,
so that a reader can view a chunk as one numpy array without parsing it (``trace.dtypes``).
"""

from __future__ import annotations

import struct

from rsltrace.trace.mcap.records import McapHeader
from rsltrace.trace.model.event import SEGMENT_EVENTS

FORMAT_VERSION = 1
PROFILE = "ros2"
LIBRARY = "rsltrace"
"""The writer named in the header, before the version."""

TOPIC_EVENTS = "/rsltrace/events"
TOPIC_OUTPUTS = "/rsltrace/outputs"
TOPIC_ENTITIES = "/rsltrace/entities"
TOPIC_DETAILS = "/rsltrace/details"
TOPIC_FINDINGS = "/rsltrace/findings"
TOPIC_STATES = "/rsltrace/states"
TOPIC_CODE_LINES = "/rsltrace/code_lines"
TOPIC_TIMINGS = "/rsltrace/timings"
TOPIC_ROSOUT = "/rosout"
PREFIX_OWN = "/rsltrace/"
PREFIX_REQUEST = "/rsltrace/request"
PREFIX_RESPONSE = "/rsltrace/response"

METADATA_OWN = "rsltrace:"
METADATA_FORMAT = "rsltrace:format"
"""The first record after the header, so that an interrupted file is recognized, too."""
METADATA_JOB = "rsltrace:job"
METADATA_SOURCES = "rsltrace:sources"
METADATA_CODE = "rsltrace:code"
METADATA_ENVIRONMENT = "rsltrace:environment"
METADATA_GUARD = "rsltrace:guard"
METADATA_STATES = "rsltrace:states"
METADATA_EDITS = "rsltrace:edits"
METADATA_RESULT = "rsltrace:result"
METADATA_RECORDED_INPUTS = "rsltrace:fed"
METADATA_NATIVE = "rsltrace:native"
"""Only in traces of native runs: middleware, executors, clocks. See ``trace.native``."""
METADATA_ROSBAG2 = "rosbag2"
CHECKSUM_KEY = "checksum"
"""The checksum in each metadata record of rsltrace."""
CHECKSUMS_KEY = "checksums"
"""The kind of checksum, in ``rsltrace:format``; missing in files without."""
ATTACHMENT_JOB = "job.yaml"
ATTACHMENT_INDEX = "rsltrace/segments"

EVENTS_PER_SEGMENT = SEGMENT_EVENTS
"""Small enough to lose little of a killed run and to read little for one event, large enough to
compress well."""

OUTPUTS_PER_SEGMENT = 65536
"""The event that reaches this number of outputs ends a segment early: memory stays bounded even if
every event publishes thousands of messages."""

PAYLOAD_BYTES_PER_CHUNK = 512 << 10
"""A payload chunk of at least this size is closed: reading one message needs a whole chunk, and
larger ones hardly compress better."""

CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of plain little-endian CDR (XCDR version 1)."""

SCHEMA_EVENT = "rsltrace_msgs/msg/CallbackEvent"
SCHEMA_OUTPUT = "rsltrace_msgs/msg/CallbackOutput"
SCHEMA_ENTITY = "rsltrace_msgs/msg/Entity"
SCHEMA_DETAIL = "rsltrace_msgs/msg/Detail"
SCHEMA_FINDING = "rsltrace_msgs/msg/Finding"
SCHEMA_STATE = "rsltrace_msgs/msg/StateChange"
SCHEMA_CODE_LINE = "rsltrace_msgs/msg/CodeLine"
SCHEMA_TIMING = "rsltrace_msgs/msg/Timing"

SCHEMA_TEXT = {
    SCHEMA_EVENT: """\
uint64 chain_hash    # XXH3-64 of the rest of this message, seeded with the previous chain_hash
uint64 index         # 0, 1, 2, ...
uint64 stamp         # simulated time in nanoseconds
uint64 cause_event   # index of the event that produced the input; 2^64-1: none
uint64 input_hash
uint64 output_hash
uint64 state_hash    # 0: not hashed
uint32 entity        # id in /rsltrace/entities
uint32 cause_output  # which output of cause_event
uint32 outputs       # how many outputs this event has
uint8 kind
uint8 flags
""",
    SCHEMA_OUTPUT: """\
uint64 event         # index of the event
uint64 hash          # of the content
uint32 entity        # id in /rsltrace/entities
uint32 kind
uint32 sequence      # of the recorded payload in its channel; 2^32-1: not recorded
""",
    SCHEMA_ENTITY: """\
uint32 id
uint32 node          # id of the owning node; a node owns itself; 0: the run
uint8 kind
string name
string type
string detail        # JSON object
""",
    SCHEMA_DETAIL: """\
uint64 event
uint32 output        # which output of the event
string text
""",
    SCHEMA_STATE: """\
uint64 event         # index of the event after which the state is this
uint32 node          # id in /rsltrace/entities
string changes       # JSON: attributes that changed, each with its values by path
""",
    SCHEMA_CODE_LINE: """\
uint64 event         # index of the first event of which this is so
uint32 entity        # id in /rsltrace/entities
uint32 output        # which output of the event came from here; 2^32-1: what it ran is here
string place         # package/module.py:24
string function
""",
    SCHEMA_TIMING: """\
uint64 event         # index of the event
uint64 steady        # steady clock at its start, in nanoseconds
uint64 wall          # system clock at its start
uint64 duration      # from its start to its end, in nanoseconds
uint64 observer      # what observing it took within its thread, in nanoseconds
uint64 source        # system clock when its input was sent; 0: unknown
uint64 ready         # system clock when its input was received, or the timer was due; 0: unknown
uint64 sequence      # of its input, counted by who sent it; 0: unknown
uint32 thread        # of the process, counted from 1
""",
    SCHEMA_FINDING: """\
uint64 event         # index of the event it happened in
uint32 entity        # id in /rsltrace/entities of what ran
string node          # fully qualified name
string source        # clock, random, file, ...
string mode          # record, warn, error
string call
string value         # what the call gave
string stack         # lines of user code, innermost first
""",
}

EVENT_REST = struct.Struct("<QQQQQQIIIBB")
"""A CallbackEvent after its chain hash: the bytes that the chain hash covers."""

OUTPUT = struct.Struct("<QQIII")
OUTPUT_HASHED = slice(8, 24)
"""The bytes of an output (hash, entity, kind) that the event's output hash covers. Without the
sequence, so that events with the same outputs hash equally."""

OUTPUT_CONTENT = struct.Struct("<QII")
"""Only these bytes: hash, entity, kind."""

TIMING = struct.Struct("<8QI")

SEGMENT_COLUMNS = (
    "first_event",
    "events",
    "first_output",
    "outputs",
    "chain_hash",
    "start_stamp",
    "end_stamp",
    "events_offset",
    "events_length",
    "outputs_offset",
    "outputs_length",
)
"""Those of the attachment ``rsltrace/segments``, one row per segment of unsigned 64-bit integers.
``first_output`` counts from the start of the run; ``chain_hash`` is that of the segment's last
event; offsets and lengths are those of the Chunk records (0 and 0: no outputs)."""


def begins_a_trace(header: McapHeader) -> bool:
    """Whether a file with only this header is a trace whose run was killed."""
    return header.profile == PROFILE and header.library.split(" ")[0] == LIBRARY


REPLAY_DIVERGED = "the replay stopped at the first event that differs"
"""The stop reason of a replay that differs from its trace."""
