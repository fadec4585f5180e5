"""Read a rosbag2 recording as one stream of messages by time, whatever its storage."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from functools import cached_property, partial
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from rsltrace.errors import BagError, near_or_all
from rsltrace.trace.mcap.chunk import PUBLISH_TIME_BYTES
from rsltrace.trace.mcap.records import FILE_BYTES_MIN, FILE_GROWTH_MAX, MESSAGE_BYTES_MAX
from rsltrace.trace.mcap.records import MAGIC as MCAP_MAGIC
from rsltrace.trace.model.regular_file import not_regular
from rsltrace.trace.model.texts import format_duration, format_seconds
from rsltrace.trace.recordings.mcap_file import McapFile
from rsltrace.trace.recordings.metadata import NAME, read_metadata
from rsltrace.trace.recordings.sqlite_file import MAGIC as SQLITE_MAGIC
from rsltrace.trace.recordings.sqlite_file import SqliteFile
from rsltrace.trace.recordings.topic import (
    BagMessage,
    BagQos,
    BagTopic,
    Extent,
    RecordingPart,
    Storage,
    StoredTopic,
    merge,
)

# Recovery of a truncated database: its readable rows are copied into a new one, in the order they
# were written, so the end of the recording is lost.

_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")


def recover_database(path: Path, target: Path) -> str:
    """Copy the readable rows of ``path`` to ``target``; return how many in words, or nothing."""
    messages, end_ns = 0, 0
    source = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
    copy = sqlite3.connect(target)
    try:
        # Otherwise sqlite refuses a file that is shorter than its header says.
        source.execute("PRAGMA writable_schema = ON")
        for table in _TABLES:
            row = source.execute(
                "SELECT sql FROM sqlite_master WHERE type = 'table' AND name = ?", (table,)
            ).fetchone()
            if row is None:
                continue
            copy.execute(row[0])
            try:
                for values in source.execute(f"SELECT * FROM {table} NOT INDEXED ORDER BY rowid"):
                    marks = ", ".join("?" * len(values))
                    copy.execute(f"INSERT INTO {table} VALUES ({marks})", values)
            except (sqlite3.Error, UnicodeDecodeError, OverflowError):
                if table != "messages":
                    raise  # without the topics, nothing plays
        copy.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        copy.commit()
        ((messages, end_ns),) = copy.execute("SELECT COUNT(*), MAX(timestamp) FROM messages")
    except (sqlite3.Error, UnicodeDecodeError, OverflowError):
        return ""
    finally:
        source.close()
        copy.close()
    if not messages or not isinstance(end_ns, int):
        return ""
    return f"the first {messages} messages, up to log time {format_seconds(end_ns)}"


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass
class BagFiles:
    """The open storage files of a bag, in order; ``close`` closes them.

    ``compressed_messages`` is None if only the messages can tell; ``topics`` has the QoS and type
    hashes from metadata.yaml.
    """

    storage_id: str = ""
    storages: list[Storage] = field(default_factory=list)
    compressed_messages: bool | None = None
    topics: dict[tuple[str, str], tuple[tuple[BagQos, ...], str]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """What is missing from an incomplete bag."""
    _stack: ExitStack = field(default_factory=ExitStack)

    def close(self) -> None:
        self._stack.close()


def open_files(path: Path, *, recover: bool = False) -> BagFiles:
    """Open a bag's folder, or a single storage file. Raises ``BagError`` saying what to do.

    ``recover`` opens an incomplete bag, and ``notes`` say what is missing.
    """
    files = BagFiles()
    try:
        if path.is_dir():
            metadata = read_metadata(path, recover=recover)
            files.storage_id = metadata.storage_id
            files.topics = metadata.topics
            files.notes += metadata.notes
            if metadata.compression is not None:
                files.compressed_messages = metadata.compression == "message"
            for file in metadata.files:
                if recover and len(metadata.files) > 1 and file.stat().st_size == 0:
                    files.notes.append(f"{file}: the file is empty: left out")
                    continue
                _open_file(file, files, metadata.storage_id or None, recover=recover)
        elif path.is_file():
            if path.name == NAME:
                raise BagError(f"{path}: name the bag's folder, {path.parent}")
            _open_file(path, files, None, recover=recover)
        elif path.exists():
            raise BagError(f"{path} is {not_regular(path)}: name a bag's folder or file")
        else:
            raise BagError(f"{path}: there is no such bag")
    except OSError as error:
        files.close()
        raise BagError(f"{error.filename or path}: {error.strerror}") from None
    except BaseException:
        files.close()
        raise
    return files


def _open_file(path: Path, files: BagFiles, expected: str | None, *, recover: bool) -> None:
    with path.open("rb") as file:
        magic = file.read(16)
    if not magic:
        raise BagError(f"{path}: the file is empty: nothing was recorded, or the copy failed")
    readable = path
    if magic.startswith(ZSTD_MAGIC):
        readable = _decompressed(path, files)
        with readable.open("rb") as file:
            magic = file.read(16)
    storage: Storage
    if magic.startswith(MCAP_MAGIC):
        storage_id, storage = "mcap", McapFile(readable, recover=recover)
    elif magic.startswith(SQLITE_MAGIC):
        storage_id, storage = "sqlite3", _sqlite(readable, path, files, recover=recover)
    elif magic.startswith(b"#ROSBAG"):
        raise BagError(f"{path}: a ROS 1 bag; convert it with 'rosbags-convert'")
    else:
        raise BagError(
            f"{path}: not a bag: neither MCAP nor sqlite3 (name a bag's folder, or one .mcap or "
            ".db3 file)"
        )
    files._stack.callback(storage.close)
    if expected not in (None, storage_id):
        raise BagError(f"{path}: {storage_id}, but {NAME} says {expected}; run 'ros2 bag reindex'")
    files.storage_id = storage_id
    files.storages.append(storage)
    if storage.cut_off:
        files.notes.append(
            f"{path}: the recording was cut off, only its beginning plays: {storage.cut_off}"
        )


def _sqlite(path: Path, name: Path, files: BagFiles, *, recover: bool) -> SqliteFile:
    """Open a database, or its readable rows; ``name`` is the user's path."""
    try:
        return SqliteFile(path, name)
    except BagError:
        if not recover:
            raise
        folder = files._stack.enter_context(TemporaryDirectory(prefix="rsltrace-bag-"))
        target = Path(folder, path.name)
        found = recover_database(path, target)
        if not found:
            raise
        storage = SqliteFile(target, name)
        storage.cut_off = found
        return storage


def _decompressed(path: Path, files: BagFiles) -> Path:
    """Return a decompressed copy of a zstd file; both formats need random access."""
    import zstandard

    folder = files._stack.enter_context(TemporaryDirectory(prefix="rsltrace-bag-"))
    target = Path(folder, path.name.removesuffix(".zstd"))
    most = max(FILE_BYTES_MIN, FILE_GROWTH_MAX * path.stat().st_size)
    try:
        with path.open("rb") as source, target.open("wb") as sink:
            for piece in zstandard.ZstdDecompressor().read_to_iter(source, write_size=1 << 20):
                if sink.tell() > most:
                    raise BagError(
                        f"{path}: it unpacks to more than {most} bytes, which no bag does"
                    )
                sink.write(piece)
    except zstandard.ZstdError as error:
        raise BagError(f"{path}: cannot be decompressed ({error}): copy it again") from None
    return target


def select_topics(
    names: Sequence[str], topics: Sequence[str], exclude: Sequence[str], bag: str
) -> set[str]:
    """Return the names that match one of ``topics`` (none: all) and none of ``exclude``.

    ``*`` matches ``/`` too. Raises ``BagError`` with the topics of the bag if a glob of ``topics``
    matches nothing, or nothing is left.
    """
    there = sorted(set(names))
    for glob in unmatched(topics, names):
        raise BagError(f"{bag}: no topic matches {glob!r}{near_or_all(glob, there)}", glob=glob)
    selected = {
        name
        for name in names
        if (not topics or any(fnmatchcase(name, glob) for glob in topics))
        and not any(fnmatchcase(name, glob) for glob in exclude)
    }
    if not selected:
        listed = ", ".join(there) or "no topics"
        raise BagError(f"{bag}: every topic is excluded: the bag has {listed}")
    return selected


def unmatched(globs: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the globs that match none of the names."""
    return tuple(g for g in globs if not any(fnmatchcase(name, g) for name in names))


STAMP_NS_MAX = 2**63 - 1


class Bag:
    """An open recording; a context manager. Made by ``open_bag``.

    ``storage_id`` is ``"mcap"`` or ``"sqlite3"``, ``topics`` the selected topics in the order of
    the recording. ``recording_start_ns`` and ``recording_end_ns`` are the log times of the first
    and last message of the whole recording; ``start_ns`` is that of the first message that plays.
    Log times are integer nanoseconds. ``notes`` say what is missing, ``skipped`` are the topics
    that never play, ``excluded_nothing`` the globs of ``exclude`` that match no topic.
    """

    path: Path
    notes: tuple[str, ...]
    skipped: tuple[str, ...]
    excluded_nothing: tuple[str, ...]
    storage_id: str
    topics: tuple[BagTopic, ...]
    recording_start_ns: int
    recording_end_ns: int
    start_ns: int

    def __init__(
        self,
        path: Path,
        files: BagFiles,
        topics: Sequence[str],
        exclude: Sequence[str],
        start_offset_ns: int,
        duration_ns: int | None,
        skip: Callable[[StoredTopic], bool] | None,
    ) -> None:
        self.path = path
        self.notes = tuple(files.notes)
        self._skip = skip
        self.storage_id = files.storage_id
        self._files = files
        filled = [storage for storage in files.storages if storage.message_count]
        if not filled:
            empty = "the bag is empty: it holds no messages"
            if files.storages and all(storage.cut_off for storage in files.storages):
                empty = "the recording was cut off before its first whole chunk"
            notes = "".join(f"\n  {note}" for note in files.notes)
            raise BagError(f"{path}: {empty}{notes}")
        self.recording_start_ns = min(storage.start_ns for storage in filled)
        self.recording_end_ns = max(storage.end_ns for storage in filled)
        if self.recording_start_ns < 0 or self.recording_end_ns > STAMP_NS_MAX:
            raise BagError(
                f"{path}: log times are not within 0 to 2^63 - 1 nanoseconds; the recorder's clock "
                "or the file is broken"
            )
        self._first_ns = self.recording_start_ns + start_offset_ns
        self._last_ns = None if duration_ns is None else self._first_ns + duration_ns
        self._select(topics, exclude)
        self._zstd = files.compressed_messages
        if self._zstd is None:
            first = next(self.messages(), None)
            # No CDR message starts with these bytes, and a single file does not say.
            self._zstd = first is not None and first[2].startswith(ZSTD_MAGIC)
        first = next(self.messages(), None)
        if first is None:
            length = format_duration(self.recording_end_ns - self.recording_start_ns)
            raise BagError(
                f"{path}: nothing to play: no message on the selected topics"
                + (
                    f" from {format_duration(start_offset_ns)} after the start on (the bag is "
                    f"{length} long)"
                    if start_offset_ns
                    else f" ({', '.join(topic.name for topic in self.topics)})"
                )
            )
        self.start_ns = first[0]

    def messages(self) -> Iterator[BagMessage]:
        """Yield (log time in ns, index in ``topics``, CDR bytes) by (time, position).

        Lazy, with only chunks that overlap in time in memory; several iterators may run at once.
        Raises ``BagError`` at a damaged part.
        """
        pieces: list[RecordingPart] = []
        for storage, wanted in zip(self._files.storages, self._wanted, strict=True):
            for extent in storage.extents(wanted, self._first_ns):
                read = partial(self._read, storage, extent, wanted)
                pieces.append(RecordingPart(extent.start_ns, len(pieces), read))
        messages = merge(pieces)
        last_ns = self._last_ns
        if last_ns is None:
            return messages
        return takewhile(lambda message: message[0] <= last_ns, messages)

    def with_publish_time(self) -> Iterator[BagMessage]:
        """Yield messages with the publish time before the data (8 bytes, little-endian).

        Raises ``BagError`` if the recording does not have it.
        """
        if self.storage_id != "mcap":
            raise BagError(
                f"{self.path}: a {self.storage_id} recording does not keep when messages were "
                "published: play it by log_time or header_stamp"
            )
        for storage in self._files.storages:
            storage.with_publish_time = True
        try:
            yield from self.messages()
        finally:
            for storage in self._files.storages:
                storage.with_publish_time = False

    @cached_property
    def end_ns(self) -> int:
        """Log time of the last message that plays."""
        if self._last_ns is not None:
            return max(stamp_ns for stamp_ns, _, _ in self.messages())
        ends = [
            storage.last_ns(wanted, self._first_ns)
            for storage, wanted in zip(self._files.storages, self._wanted, strict=True)
        ]
        return max(end_ns for end_ns in ends if end_ns is not None)

    @cached_property
    def message_count(self) -> int:
        """The number of messages that play. A start offset must read the skipped part."""
        return sum(
            storage.count(wanted, self._first_ns)
            for storage, wanted in zip(self._files.storages, self._wanted, strict=True)
        )

    def close(self) -> None:
        """Close the recording. Its iterators end."""
        self._files.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _select(self, globs: Sequence[str], exclude: Sequence[str]) -> None:
        """Set ``topics`` and the map from each storage file's topic ids to their indices."""
        everything = [topic for storage in self._files.storages for topic in storage.topics]
        skipped = [topic for topic in everything if self._skip is not None and self._skip(topic)]
        self.skipped = tuple(dict.fromkeys(topic.name for topic in skipped))
        self.excluded_nothing = unmatched(exclude, [topic.name for topic in everything])
        names = [topic.name for topic in everything if topic.name not in self.skipped]
        selected = select_topics(names, globs, exclude, str(self.path))
        merged: dict[tuple[str, str, str], BagTopic] = {}
        ids: list[dict[int, tuple[str, str, str]]] = []
        for storage in self._files.storages:
            ids.append({})
            for stored in storage.topics:
                if stored.name not in selected:
                    continue
                key = (stored.name, stored.type_name, stored.serialization_format)
                ids[-1][stored.id] = key
                new = self._topic(stored)
                merged[key] = _joined_topic(merged[key], new) if key in merged else new
        self.topics = tuple(merged.values())
        for topic in self.topics:
            if topic.serialization_format != "cdr":
                raise BagError(
                    f"{self.path}: topic {topic.name} is encoded as "
                    f"{topic.serialization_format!r}; only ROS 2's 'cdr' can play: exclude it"
                )
        index = {key: number for number, key in enumerate(merged)}
        self._wanted = [{i: index[key] for i, key in by_id.items()} for by_id in ids]

    def _topic(self, stored: StoredTopic) -> BagTopic:
        offered, type_hash = self._files.topics.get((stored.name, stored.type_name), ((), ""))
        topic = BagTopic(*(getattr(stored, field.name) for field in fields(BagTopic)))
        return replace(
            topic,
            offered_qos=topic.offered_qos or offered,
            type_hash=topic.type_hash or type_hash,
        )

    def _read(
        self, storage: Storage, extent: Extent, wanted: dict[int, int]
    ) -> Iterator[BagMessage]:
        messages = storage.read(extent, wanted, self._first_ns)
        if not self._zstd:
            return messages
        return self._decompressed(messages, PUBLISH_TIME_BYTES * storage.with_publish_time)

    def _decompressed(self, messages: Iterator[BagMessage], head: int) -> Iterator[BagMessage]:
        """Yield messages with the bytes after the first ``head`` decompressed."""
        import zstandard

        decompressor = zstandard.ZstdDecompressor()
        for stamp_ns, topic, data in messages:
            try:
                if zstandard.frame_content_size(data[head:]) > MESSAGE_BYTES_MAX:
                    raise zstandard.ZstdError(f"it has more than {MESSAGE_BYTES_MAX} bytes")
                yield stamp_ns, topic, data[:head] + decompressor.decompress(data[head:])
            except zstandard.ZstdError as error:
                raise BagError(
                    f"{self.path}: a message on {self.topics[topic].name} at {stamp_ns} ns cannot "
                    f"be decompressed ({error})"
                ) from None


def _joined_topic(one: BagTopic, other: BagTopic) -> BagTopic:
    """Join what two channels, or two files of a split bag, say about one topic."""
    new_qos = tuple(qos for qos in other.offered_qos if qos not in one.offered_qos)
    schema = one if one.schema_text else other
    return replace(
        one,
        offered_qos=one.offered_qos + new_qos,
        message_count=one.message_count + other.message_count,
        schema_text=schema.schema_text,
        schema_encoding=schema.schema_encoding,
        type_hash=one.type_hash or other.type_hash,
    )


def open_bag(
    path: str | os.PathLike[str],
    *,
    topics: Sequence[str] = (),
    exclude: Sequence[str] = (),
    start_offset_ns: int = 0,
    duration_ns: int | None = None,
    recover: bool = False,
    skip: Callable[[StoredTopic], bool] | None = None,
) -> Bag:
    """Open a rosbag2 recording: a folder with metadata.yaml, or one ``.mcap`` or ``.db3`` file.

    ``topics`` and ``exclude`` are globs (``*`` matches ``/`` too; no ``topics`` means all).
    ``start_offset_ns`` counts from the first message of the recording, ``duration_ns`` from there.
    ``recover`` opens an incomplete recording, and ``notes`` say what is missing. ``skip`` picks
    topics that never play, listed in ``skipped``. Raises ``BagError`` naming the file and what to
    do.
    """
    if start_offset_ns < 0:
        raise BagError(f"{path}: the start offset must not be negative, got {start_offset_ns} ns")
    files = open_files(Path(path), recover=recover)
    try:
        return Bag(Path(path), files, topics, exclude, start_offset_ns, duration_ns, skip)
    except BaseException:
        files.close()
        raise
