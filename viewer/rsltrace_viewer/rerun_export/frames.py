"""Coordinate frames: which there are, how they hang together, and what a view can show of them.

A three-dimensional view shows what is connected to its frame; anything else in it is an error. So
there is one view per tree of frames, looking from the tree's root. With two runs every frame has
the run's prefix (``a/odom``), since Rerun knows frames by name wherever they are; the roots of the
same name are joined, so that both runs are in one picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace_viewer.rerun_export.columns import make_chunk
from rsltrace_viewer.rerun_export.paths import join


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
