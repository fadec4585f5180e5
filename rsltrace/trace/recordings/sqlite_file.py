"""Read rosbag2's sqlite3 storage (``.db3``), all schema versions.

rosbag2's index on the time column gives the order (time, row), so a query streams in bounded
memory.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rsltrace.errors import BagError
from rsltrace.trace.recordings.topic import BagMessage, Extent, StoredTopic, parse_qos

MAGIC = b"SQLite format 3\0"
_HEADER_BYTES = 100
_ERRORS = (sqlite3.Error, UnicodeDecodeError, OverflowError)
"""Errors for a damaged file: sqlite3 decodes text outside its own errors."""

_REPAIR = "recover it with sqlite3's '.recover', then run 'ros2 bag reindex' on the bag's folder"


class SqliteFile:
    """One open ``.db3`` file. Raises ``BagError`` when it is no rosbag2 database or damaged."""

    def __init__(self, path: Path, name: Path | None = None) -> None:
        """Open ``path``, a copy of the user's file ``name`` if that is given."""
        self.path = path
        self.name = name or path
        self.cut_off = ""
        self.with_publish_time = False
        self._check_size()
        # A non-empty WAL holds messages outside the main file. Without one the file is opened as
        # immutable, which also works on read-only media.
        wal = path.with_name(path.name + "-wal")
        mode = "mode=ro" if wal.exists() and wal.stat().st_size else "mode=ro&immutable=1"
        try:
            uri = f"file:{quote(str(path.absolute()))}?{mode}"
            self._db = sqlite3.connect(uri, uri=True)
        except sqlite3.Error as error:
            raise self._damaged(error) from None
        try:
            self._open()
        except BaseException:
            self._db.close()
            raise

    def close(self) -> None:
        self._db.close()

    def extents(self, wanted: Mapping[int, int], first_ns: int) -> list[Extent]:
        """Return the whole database as one extent, if it has any wanted message."""
        ids, end_ns = self._ids(wanted), self.end_ns
        if not ids or end_ns < first_ns:
            return []
        return [Extent(0, 0, max(self.start_ns, first_ns), end_ns)]

    def read(
        self, extent: Extent, wanted: Mapping[int, int], first_ns: int
    ) -> Iterator[BagMessage]:
        """Yield the wanted messages by (time, row)."""
        ids = self._ids(wanted)
        query = "SELECT timestamp, topic_id, data FROM messages WHERE timestamp >= ?"
        if any(topic.message_count for topic in self.topics if topic.id not in wanted):
            query += f" AND topic_id IN ({', '.join(map(str, ids))})"
        try:
            for stamp_ns, topic, data in self._db.execute(
                f"{query} ORDER BY timestamp, rowid", (first_ns,)
            ):
                # sqlite allows any type in any column; damaged files have them.
                if type(stamp_ns) is not int or type(data) is not bytes or topic not in wanted:
                    raise BagError(
                        f"{self.name}: the row at time {stamp_ns!r} is not a message; {_REPAIR}"
                    )
                yield stamp_ns, wanted[topic], data
        except _ERRORS as error:
            raise self._damaged(error) from None

    def count(self, wanted: Mapping[int, int], first_ns: int) -> int:
        if first_ns <= self.start_ns:
            return sum(topic.message_count for topic in self.topics if topic.id in wanted)
        ids = ", ".join(map(str, self._ids(wanted)))
        ((count,),) = self._rows(
            f"SELECT COUNT(*) FROM messages WHERE timestamp >= ? AND topic_id IN ({ids})", first_ns
        )
        return int(count)

    def last_ns(self, wanted: Mapping[int, int], first_ns: int) -> int | None:
        ids = ", ".join(map(str, self._ids(wanted)))
        rows = self._rows(
            f"SELECT timestamp FROM messages WHERE timestamp >= ? AND topic_id IN ({ids}) "
            "ORDER BY timestamp DESC LIMIT 1",
            first_ns,
        )
        return int(rows[0][0]) if rows else None

    def _open(self) -> None:
        columns = {row[1] for row in self._rows("PRAGMA table_info(topics)")}
        stored = {row[1] for row in self._rows("PRAGMA table_info(messages)")}
        if not {"id", "name", "type", "serialization_format"} <= columns or not (
            {"topic_id", "timestamp", "data"} <= stored
        ):
            raise BagError(f"{self.name}: a database, but not one of rosbag2 (tables are missing)")
        if self._rows("SELECT 1 FROM sqlite_master WHERE type = 'view'"):  # it may have no end
            raise BagError(f"{self.name}: a database with views, which rosbag2 does not make")
        counts = dict(self._rows("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"))
        ((self.start_ns,),) = self._rows("SELECT IFNULL(MIN(timestamp), 0) FROM messages")
        ((self.end_ns,),) = self._rows("SELECT IFNULL(MAX(timestamp), 0) FROM messages")
        if type(self.start_ns) is not int or type(self.end_ns) is not int:
            raise BagError(f"{self.name}: the column of times holds something else; {_REPAIR}")
        self.message_count = sum(counts.values())

        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        type_hash = "type_description_hash" if "type_description_hash" in columns else "''"
        definitions = self._definitions()
        self.topics = []
        for row in self._rows(
            f"SELECT id, name, type, serialization_format, {qos}, {type_hash} "
            "FROM topics ORDER BY id"
        ):
            encoding, text = definitions.get(str(row[2]), ("", None))
            try:
                offered = parse_qos(row[4])
            except ValueError as error:
                raise BagError(f"{self.name}: topic {row[1]}: {error}") from None
            self.topics.append(
                StoredTopic(
                    id=row[0],
                    name=str(row[1]),
                    type_name=str(row[2]),
                    serialization_format=str(row[3]),
                    offered_qos=offered,
                    message_count=counts.pop(row[0], 0),
                    schema_text=text,
                    schema_encoding=encoding,
                    type_hash=str(row[5] or ""),
                )
            )
        if counts:
            raise BagError(
                f"{self.name}: {sum(counts.values())} messages are of topics that are not listed; "
                f"{_REPAIR}"
            )

    def _definitions(self) -> dict[str, tuple[str, str]]:
        if not self._rows("PRAGMA table_info(message_definitions)"):
            return {}
        rows = self._rows(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        return {str(name): (str(encoding), str(text)) for name, encoding, text in rows if text}

    def _ids(self, wanted: Mapping[int, int]) -> list[int]:
        return [topic.id for topic in self.topics if topic.id in wanted and topic.message_count]

    def _rows(self, query: str, *values: int) -> list[Any]:
        try:
            return self._db.execute(query, values).fetchall()
        except _ERRORS as error:
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> BagError:
        return BagError(f"{self.name}: the database cannot be read ({error}); {_REPAIR}")

    def _check_size(self) -> None:
        """Compare the file's size with its header; sqlite would notice late."""
        with self.path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
        if not header.startswith(MAGIC):
            raise BagError(f"{self.name}: not a sqlite3 database")
        size = self.path.stat().st_size
        page = int.from_bytes(header[16:18], "big")
        pages = int.from_bytes(header[28:32], "big")
        # 1 stands for 65536. The count only holds if the last writer kept it (bytes 24 and 92).
        expected = pages * (65536 if page == 1 else page)
        if len(header) < _HEADER_BYTES or (header[24:28] == header[92:96] and size < expected):
            raise BagError(
                f"{self.name}: the database was cut off: {size} of {expected} bytes are there; "
                f"{_REPAIR}"
            )
