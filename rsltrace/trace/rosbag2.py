"""The ``rosbag2`` metadata record, which makes ``ros2 bag`` accept a trace as a bag.

rosbag2's MCAP plugin stores its metadata (version 9 since Jazzy) as YAML in a metadata record. It
is written by hand in the plugin's order of keys, which spares recording a YAML library. The file
name in it is fixed; readers put in the real one.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence

from rsltrace.errors import OutputError
from rsltrace.fast_dataclass import dataclass

BAG_METADATA_VERSION = 9
FILE_NAME = "trace.mcap"
KEY = "serialized_metadata"

_PLAIN = re.compile(r"[/A-Za-z_][/A-Za-z0-9_]*(?:\.mcap)?")
_NOT_TEXT = frozenset(("null", "true", "false", "yes", "no", "on", "off", "y", "n"))


@dataclass(frozen=True, slots=True)
class BagTopicMetadata:
    """One channel as rosbag2 lists it. ``qos_yaml`` is a YAML sequence (``[]`` if unknown)."""

    name: str
    type: str
    type_hash: str
    qos_yaml: str
    message_count: int


def bag_metadata_yaml(
    topics: Sequence[BagTopicMetadata],
    *,
    start_ns: int,
    duration_ns: int,
    ros_distro: str,
    file_name: str = FILE_NAME,
) -> str:
    """Return the YAML of a bag whose only file is ``file_name``. Times are in nanoseconds."""
    message_count = sum(topic.message_count for topic in topics)
    lines = [
        f"version: {BAG_METADATA_VERSION}",
        "storage_identifier: mcap",
        "duration:",
        f"  nanoseconds: {duration_ns}",
        "starting_time:",
        f"  nanoseconds_since_epoch: {start_ns}",
        f"message_count: {message_count}",
        "topics_with_message_count:" + ("" if topics else " []"),
    ]
    for topic in topics:
        lines += [
            "  - topic_metadata:",
            f"      name: {_scalar(topic.name)}",
            f"      type: {_scalar(topic.type)}",
            "      serialization_format: cdr",
            *_qos_lines(topic.qos_yaml),
            f"      type_description_hash: {_scalar(topic.type_hash)}",
            f"    message_count: {topic.message_count}",
        ]
    lines += [
        'compression_format: ""',
        'compression_mode: ""',
        "relative_file_paths:",
        f"  - {_scalar(file_name)}",
        "files:",
        f"  - path: {_scalar(file_name)}",
        "    starting_time:",
        f"      nanoseconds_since_epoch: {start_ns}",
        "    duration:",
        f"      nanoseconds: {duration_ns}",
        f"    message_count: {message_count}",
        "custom_data: ~",
        f"ros_distro: {_scalar(ros_distro)}",
    ]
    return "\n".join(lines) + "\n"


def normalized_qos(qos_yaml: str, *, topic: str) -> str:
    """Return ``qos_yaml`` ready to be stored: ``[]`` for nothing, no newline at its end.

    rosbag2 expects a sequence and refuses an empty text. Raises OutputError for a text that cannot
    be a YAML sequence: a player would fail on it.
    """
    text = textwrap.dedent(qos_yaml).strip("\n")
    if not text.strip():
        return "[]"
    one_line = "\n" not in text and text.startswith("[") and text.endswith("]")
    if not one_line and not text.startswith("- "):
        raise OutputError(
            f"the QoS profiles of {topic} cannot be written: expected a YAML sequence "
            f"('- history: …'), got {text.splitlines()[0]!r}"
        )
    return text


def _qos_lines(qos_yaml: str) -> list[str]:
    if qos_yaml.startswith("["):
        return [f"      offered_qos_profiles: {qos_yaml}"]
    return ["      offered_qos_profiles:", textwrap.indent(qos_yaml, " " * 8)]


def _scalar(text: str) -> str:
    """Quote texts that YAML could take for something other than a string."""
    plain = _PLAIN.fullmatch(text) and text.lower() not in _NOT_TEXT
    return text if plain else json.dumps(text)
