"""What can be read of a database that was cut off: copied, row by row, into a whole one.

Rows are taken in the order they were written, so what is lost is the end of the recording.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path
from urllib.parse import quote

from rsltrace.trace.model.stamp import format_seconds

_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")


def recover_database(path: Path, target: Path) -> str:
    """Copy what is readable of ``path`` to ``target``; return how much it is, or nothing."""
    messages, end_ns = 0, 0
    source = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
    copy = sqlite3.connect(target)
    try:
        # Without this, sqlite refuses a file that is shorter than its header says.
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
