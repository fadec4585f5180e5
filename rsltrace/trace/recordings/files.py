"""Open the storage files of a bag, decompressed first if they are zstd."""

from __future__ import annotations

import sqlite3
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from rsltrace.errors import BagError
from rsltrace.trace.mcap.records import FILE_BYTES_MIN, FILE_GROWTH_MAX
from rsltrace.trace.mcap.records import MAGIC as MCAP_MAGIC
from rsltrace.trace.model.regular_file import not_regular
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.recordings.mcap_file import McapFile
from rsltrace.trace.recordings.metadata import NAME, read_metadata
from rsltrace.trace.recordings.sqlite_file import MAGIC as SQLITE_MAGIC
from rsltrace.trace.recordings.sqlite_file import SqliteFile
from rsltrace.trace.recordings.topic import BagQos, Storage

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
    return f"the first {messages} messages, up to log time {format_seconds(end_ns)},"


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
        files.notes.append(f"{path}: the recording was cut off: {storage.cut_off} play")


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
