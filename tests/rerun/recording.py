"""A Rerun recording, loaded back."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

os.environ["RERUN_ANALYTICS_ENABLED"] = "0"

import pyarrow as pa
from rerun.chunk import RrdReader


def rows_of(batch: pa.RecordBatch) -> list[dict[str, Any]]:
    """Return rows as dicts, times as integers of nanoseconds."""
    columns = [
        column.cast(pa.int64()) if pa.types.is_temporal(column.type) else column
        for column in batch.columns
    ]
    return pa.RecordBatch.from_arrays(columns, names=batch.schema.names).to_pylist()


class Recording:
    """A recording as one list of rows (dicts) per entity; static rows apart."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, list[dict[str, Any]]] = {}
        self.static: dict[str, dict[str, Any]] = {}
        self.timelines: set[str] = set()
        reader = RrdReader(str(path))
        self.blueprints = reader.blueprints()
        self.recordings = reader.recordings()
        self.views = set()
        self.layout: dict[str, list[Any]] = {}
        self.view_names: dict[str, str] = {}
        self.active_tabs: list[str] = []
        for chunk in reader.stream():
            place = str(chunk.entity_path)
            rows = rows_of(chunk.to_record_batch())
            self.timelines |= set(chunk.timeline_names)
            if chunk.is_static:
                for row in rows:
                    self.static.setdefault(place, {}).update(row)
            else:
                self.rows.setdefault(place, []).extend(rows)
        self.order = "row" if "row" in self.timelines else "event"
        for store in self.blueprints:
            for chunk in reader.stream(store=store):
                for row in rows_of(chunk.to_record_batch()):
                    self.views.update(row.get("ViewBlueprint:class_identifier") or [])
                    self.layout.update((key, one) for key, one in row.items() if one is not None)
                    self.active_tabs += row.get("ContainerBlueprint:active_tab") or []
                    for name in row.get("ViewBlueprint:display_name") or []:
                        self.view_names[str(chunk.entity_path).strip("/")] = name

    def values(self, place: str, component: str) -> list[Any]:
        """Return a component of an entity, row by row, in the order of events."""
        rows = [r for r in self.rows[place] if r.get(component) is not None]
        rows.sort(key=lambda row: (row.get(self.order) or 0, row["rerun.controls.RowId"]))
        return [row[component] for row in rows]

    def events(self, place: str, component: str) -> list[int]:
        """Return the events at which a component of an entity was set, in order."""
        return sorted(r[self.order] for r in self.rows[place] if r.get(component) is not None)
