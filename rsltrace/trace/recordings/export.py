"""Export a trace's messages as a plain rosbag2 recording: metadata.yaml and one MCAP file.

A trace is a bag already, with more in it; some tools and people want only the bag.
"""

from __future__ import annotations

import os
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

from mcap.writer import CompressionType, Writer

from rsltrace._version import __version__
from rsltrace.errors import OutputError
from rsltrace.trace.format import PREFIX_OWN, PROFILE
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings.metadata import NAME
from rsltrace.trace.recordings.reader import open_bag
from rsltrace.trace.rosbag2 import BagTopicMetadata, bag_metadata_yaml

_PROGRESS_EVERY = 1000
_QOS, _HASH = "offered_qos_profiles", "topic_type_hash"


def check_bag_folder(folder: Path, *, force: bool) -> None:
    """Raise OutputError if a bag cannot be written to ``folder``.

    ``force`` allows to replace a bag, but no other folder.
    """
    if not folder.parent.is_dir():
        raise OutputError(
            f"cannot write the bag {folder}: the folder {folder.parent} does not exist; create it"
        )
    if not folder.exists() and not folder.is_symlink():
        return
    if not force:
        force_it = "--force (in Python: force=True)"
        raise OutputError(f"cannot write the bag {folder}: it exists; use {force_it} to replace it")
    if not folder.is_dir() or (any(folder.iterdir()) and not (folder / NAME).is_file()):
        raise OutputError(
            f"cannot write the bag {folder}: the existing folder is not a bag (no {NAME} in it), "
            "so --force does not replace it; choose another name"
        )


def export_bag(
    trace: Path,
    folder: Path,
    *,
    topics: Sequence[str] = ("*",),
    exclude: Sequence[str] = (),
    force: bool = False,
    progress: Callable[[int, int], None] = lambda written, total: None,
) -> int:
    """Write the messages of a trace as the bag ``folder``; return their number.

    ``progress`` is called now and then with the numbers written and in total. ``topics`` and
    ``exclude`` are globs, in which ``*`` matches ``/`` too. The folder appears when it is complete:
    a failure leaves nothing, and keeps what was there.

    :raises TraceError: if the trace cannot be read.
    :raises OutputError: if the bag cannot be written.
    """
    folder = Path(os.path.abspath(folder))
    check_bag_folder(folder, force=force)
    with Trace.open(trace) as opened:
        channels = chosen_channels(opened, topics, exclude)
        counts = {channel.id: opened.message_counts.get(channel.id, 0) for channel in channels}
        distro = opened.environment.get("ros_distro", "")
    name = f"{folder.name}_0.mcap"
    with _replacing(folder) as work:
        kept = [channel for channel in channels if counts[channel.id]]
        start_ns, end_ns = _write(
            trace, work / name, channels, kept, lambda done: progress(done, sum(counts.values()))
        )
        listed = [
            BagTopicMetadata(
                name=channel.topic,
                type=channel.type,
                type_hash=channel.metadata.get(_HASH, ""),
                qos_yaml=channel.metadata.get(_QOS, "[]"),
                message_count=counts[channel.id],
            )
            for channel in channels
        ]
        text = bag_metadata_yaml(
            listed,
            start_ns=start_ns,
            duration_ns=end_ns - start_ns,
            ros_distro=distro or "rsltrace",
            file_name=name,
        )
        content = f"rosbag2_bagfile_information:\n{textwrap.indent(text, '  ')}"
        (work / NAME).write_text(content, encoding="utf-8")
    return sum(counts.values())


def chosen_channels(
    trace: Trace, topics: Sequence[str], exclude: Sequence[str]
) -> list[ChannelInfo]:
    """Return the channels of ROS topics that globs choose, by number."""
    return [
        channel
        for _, channel in sorted(trace.channels.items())
        if not channel.topic.startswith(PREFIX_OWN)
        and any(fnmatchcase(channel.topic, glob) for glob in topics)
        and not any(fnmatchcase(channel.topic, glob) for glob in exclude)
    ]


def _write(
    trace: Path,
    path: Path,
    channels: Sequence[ChannelInfo],
    kept: Sequence[ChannelInfo],
    progress: Callable[[int], None],
) -> tuple[int, int]:
    """Write the MCAP file; return the times of its first and last message, 0 if it has none."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(PROFILE, library=f"rsltrace {__version__}")
        schemas: dict[str, int] = {}
        ids: dict[str, int] = {}
        for channel in channels:
            if channel.type not in schemas:
                schemas[channel.type] = writer.register_schema(
                    channel.type, channel.schema_encoding, channel.schema_text.encode()
                )
            ids[channel.topic] = writer.register_channel(
                channel.topic, "cdr", schemas[channel.type], dict(channel.metadata)
            )
        start_ns = end_ns = 0
        if kept:
            with open_bag(trace, topics=[_literal(c.topic) for c in kept], recover=True) as bag:
                sequences = dict.fromkeys(ids, 0)
                start_ns = bag.start_ns
                for written, (end_ns, number, data) in enumerate(bag.messages()):
                    if written % _PROGRESS_EVERY == 0:
                        progress(written)
                    topic = bag.topics[number].name
                    sequences[topic] += 1
                    writer.add_message(
                        ids[topic], end_ns, data, publish_time=end_ns, sequence=sequences[topic]
                    )
        writer.finish()  # type: ignore[no-untyped-call]
    return start_ns, end_ns


def _literal(topic: str) -> str:
    """Return the glob that matches only a topic; traces from elsewhere may have any name."""
    return re.sub(r"[*?[]", r"[\g<0>]", topic)


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """Give a folder to work in, which replaces ``folder`` when the block ends well."""
    work = folder.parent / f".{folder.name}.part-{os.getpid()}"
    old = folder.parent / f".{folder.name}.old-{os.getpid()}"
    try:
        work.mkdir()
        yield work
        if folder.exists():
            folder.rename(old)
        work.rename(folder)
    except OSError as error:
        if old.exists() and not folder.exists():
            old.rename(folder)
        reason = error.strerror or str(error)
        raise OutputError(f"cannot write the bag {folder}: {reason}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
