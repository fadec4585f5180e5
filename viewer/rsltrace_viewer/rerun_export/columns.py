"""Chunks for Rerun, built from whole columns: a call per ten thousand rows, not one per row.

Rerun takes Arrow record batches whose field metadata says which component a column holds. Building
them here keeps texts as Arrow arrays all the way, which its own column helpers turn into lists.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace_viewer.rerun_export.moments import join

if TYPE_CHECKING:
    from rerun import ComponentDescriptor

    from rsltrace.diff.alignment.aligned_rows import AlignedRows

# Colours: by topic in one run; by run, with shades by topic, in two; neutral for lanes, so that
# red and green are left to what differs and what agrees.
#
# Blue and orange are distinguishable for people who do not see all colours, and on paper.

_BY_TOPIC = (0x4FC3F7FF, 0xFFB74DFF, 0x81C784FF, 0xE57373FF, 0xBA68C8FF, 0xFFF176FF, 0xA1887FFF)
_BY_RUN = {
    "a": (0x4FA3FFFF, 0x1F6FEBFF, 0x9CCBFFFF, 0x5E7CE2FF),
    "b": (0xFF9D3BFF, 0xE06C00FF, 0xFFC98FFF, 0xC98A2BFF),
}


_BY_AXIS = {
    "x": (0xE53935FF, 0xFFA39EFF),
    "y": (0x43A047FF, 0xA9DFABFF),
    "z": (0x2979FFFF, 0xA6C8FFFF),
    "w": (0xFFB300FF, 0xFFE39BFF),
}
"""As in RViz, the lighter ones for b."""

AXES = frozenset(_BY_AXIS)


def colour(root: str, number: int, name: str = "") -> int:
    """Return the colour (0xRRGGBBAA) of topic or curve ``number`` in a run (``a``, ``b`` or ""); a
    curve that is called ``x``, ``y``, ``z`` or ``w`` has that of the axis."""
    if name in _BY_AXIS:
        return _BY_AXIS[name][root == "b"]
    shades = _BY_RUN.get(root, _BY_TOPIC)
    return shades[number % len(shades)]


_LANES = (0x5B7083FF, 0x8296A8FF, 0x46586AFF, 0x6C7F93FF, 0x9BAAB8FF)


def lane(number: int) -> int:
    """Return the colour (0xRRGGBBAA) of callback ``number`` of a node."""
    return _LANES[number % len(_LANES)]


Component: TypeAlias = "ComponentDescriptor | pa.Field | str"
"""Of Rerun's, as a loaded chunk has it, or one of ours by its name."""
Column = tuple[Component, pa.Array]
"""A component with its values: one per row, or a list per row."""

Times = tuple[tuple[str, pa.Array], ...]

SIM_TIME = "sim_time"
EVENT, ROW = "event", "row"
"""What counts events: of one run by itself, of two by their aligned rows."""
_INT64_MAX = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Clock:
    """The timelines of a run. Simulated time is a date where it is one (``dated``), else the time
    since zero. Events of two runs count as their aligned ``rows``."""

    dated: bool
    rows: AlignedRows | None = None
    of_b: bool = False

    @property
    def order(self) -> str:
        """The timeline that counts events."""
        return EVENT if self.rows is None else ROW

    def places(self, events: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return where events of this run are on that timeline."""
        return events if self.rows is None else self.rows.places_of(events, of_b=self.of_b)

    def times(self, stamps_ns: npt.NDArray[Any], events: npt.NDArray[np.int64]) -> Times:
        return (SIM_TIME, self.array(stamps_ns)), (self.order, pa.array(self.places(events)))

    @property
    def timeline_type(self) -> str:
        """The name Rerun's MCAP reader has for it."""
        return "timestamp_ns" if self.dated else "duration_ns"

    def array(self, stamps_ns: npt.NDArray[Any]) -> pa.Array:
        """Return stamps (any integers, nanoseconds, shape (n,)) as the ``sim_time`` column."""
        clipped = np.minimum(stamps_ns, np.asarray(_INT64_MAX, dtype=stamps_ns.dtype))
        kind = pa.timestamp("ns") if self.dated else pa.duration("ns")
        return pa.array(clipped.astype(np.int64)).cast(kind)


_DATES_FROM_NS = 315_532_800 * 1_000_000_000
"""1980. A simulation starts near zero; what is recorded on a robot has the time of day."""


def clocks_for(start_ns: Sequence[int], rows: AlignedRows | None = None) -> list[Clock]:
    """Return the timelines of runs that started then: with dates if one of them began so."""
    dated = any(start >= _DATES_FROM_NS for start in start_ns)
    return [Clock(dated, rows, of_b=bool(nth)) for nth in range(len(start_ns))]


def make_chunk(
    path: str,
    times: Sequence[tuple[str, pa.Array]],
    columns: Sequence[Column],
) -> list[Chunk]:
    """Return the chunk (as a list of one) of an entity; without ``times`` it is static."""
    fields = [pa.field(name, values.type) for name, values in times]
    fields += [_field(component, values) for component, values in columns]
    batch = pa.RecordBatch.from_arrays(
        [values for _, values in (*times, *columns)], schema=pa.schema(fields)
    )
    index = [name for name, _ in times] or None
    chunks: list[Chunk] = Chunk.from_record_batch(batch, index=index, entity_path=path)
    return chunks


def lane_colours(path: str, colours: Mapping[str, int]) -> list[Chunk]:
    """Return the chunk that gives the states of a lane their colours (0xRRGGBBAA)."""
    one = np.array([len(colours)])
    configuration = rr.StateConfiguration
    paints = pa.array(colours.values(), type=pa.uint32())
    return make_chunk(
        path,
        (),
        (
            (configuration.descriptor_values(), lists(one, pa.array(colours))),
            (configuration.descriptor_colors(), lists(one, paints)),
        ),
    )


def _field(component: Component, values: pa.Array) -> pa.Field:
    if isinstance(component, pa.Field):
        return component
    if isinstance(component, str):
        return pa.field(component, values.type)
    metadata = {
        "rerun:component": component.component,
        "rerun:archetype": component.archetype or "",
        "rerun:component_type": component.component_type or "",
        "rerun:kind": "data",
    }
    return pa.field(component.component, values.type, metadata=metadata)


def lists(counts: npt.NDArray[np.integer[Any]], values: pa.Array) -> pa.Array:
    """Return ``values`` cut into lists of ``counts`` items (shape (rows,)) each."""
    offsets = np.zeros(len(counts) + 1, dtype=np.int32)
    np.cumsum(counts, out=offsets[1:])
    return pa.ListArray.from_arrays(pa.array(offsets), values)


def strip_lists(counts: npt.NDArray[np.integer[Any]], points: pa.Array) -> pa.Array:
    """Return ``points`` cut into strips of ``counts`` points; a strip has no missing points."""
    strips = lists(counts, points)
    kind = pa.list_(pa.field("item", points.type, nullable=False))
    return pa.ListArray.from_arrays(strips.offsets, points, type=kind)


def vectors(values: npt.NDArray[np.floating[Any]]) -> pa.Array:
    """Return an array of shape (n, k) as n lists of k float32, as Rerun has positions."""
    size = values.shape[1]
    flat = pa.array(np.ascontiguousarray(values, dtype=np.float32).reshape(-1))
    kind = pa.list_(pa.field("item", pa.float32(), nullable=False), size)
    return pa.FixedSizeListArray.from_arrays(flat, type=kind)


def constant(value: Any, rows: int, kind: pa.DataType | None = None) -> pa.Array:
    return pa.repeat(pa.scalar(value, type=kind), rows)


# Coordinate frames: which there are, how they hang together, and what a view can show of them.
#
# A three-dimensional view shows what is connected to its frame; anything else in it is an error.
# So there is one view per tree of frames, looking from the tree's root. With two runs every frame
# has the run's prefix (``a/odom``), since Rerun knows frames by name wherever they are; the roots
# of the same name are joined, so that both runs are in one picture.


@dataclass(slots=True)
class FrameTree:
    """What was seen of the frames of one run, by names without the run's prefix."""

    parents: dict[str, str] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)
    """By entity path, the frame its data is in."""
    drawn: set[str] = field(default_factory=set)
    """Paths at which there is something to see in three dimensions."""

    def add_edge(self, parent: str, child: str) -> None:
        """Note that a transform places ``child`` in ``parent``."""
        if parent and child and parent != child:
            self.parents.setdefault(child, parent)

    def root_of(self, frame: str) -> str:
        """Return the frame at the top of the tree that ``frame`` is in."""
        seen = {frame}
        while (parent := self.parents.get(frame)) is not None and parent not in seen:
            seen.add(parent)
            frame = parent
        return frame

    def by_root(self) -> dict[str, list[str]]:
        """Return, by root frame, the paths of what is drawn in its tree; most first."""
        result: dict[str, list[str]] = {}
        for path, frame in self.frames.items():
            if path in self.drawn:
                result.setdefault(self.root_of(frame), []).append(path)
        return dict(sorted(result.items(), key=lambda item: -len(item[1])))


def joining_chunks(prefixes: list[str], trees: list[FrameTree]) -> Iterator[Chunk]:
    """Yield what joins the root frames of several runs: ``a/odom`` and ``b/odom`` in ``odom``."""
    for prefix, tree in zip(prefixes, trees, strict=True):
        for root in tree.by_root():
            yield from make_chunk(
                join("frames", root or "(none)", prefix),
                (),
                (
                    (rr.Transform3D.descriptor_parent_frame(), pa.array([root])),
                    (rr.Transform3D.descriptor_child_frame(), pa.array([f"{prefix}/{root}"])),
                ),
            )
