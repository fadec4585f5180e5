"""What the viewer shows first: the blueprint made for a trace, saved with it.

Above, the world: one three-dimensional view per tree of frames, images, and the plots that say
most. Below, the run: a lane per node, the log, the table of events, the rates. Of two runs, the
verdict stands first, and what differs is what is plotted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.api import Container, View

from rsltrace.trace.model.texts import NS_PER_S
from rsltrace_viewer.rerun_export.columns import EVENT, ROW, SIM_TIME
from rsltrace_viewer.rerun_export.divergence import Distances, Key, curve_keys
from rsltrace_viewer.rerun_export.events.chunks import NUMBER
from rsltrace_viewer.rerun_export.moments import NO_NODE
from rsltrace_viewer.rerun_export.run import Shown

if TYPE_CHECKING:
    from rsltrace_viewer.rerun_export.divergence import DivergenceMarks

_PLOTS_SHOWN = 3
_PLOTS_MAX = 16
IMAGES_MAX = 4
_LANES_MAX = 64
_FIRST_FIELDS = ("pose.position", "position", "linear", "angular", "data")
"""Fields that say most at a glance, in this order; a name in a path counts."""
_LAST_TOPICS = ("/parameter_events", "/rosout", "/clock", "/rsltrace/")
_LAST_FIELDS = ("latitude", "altitude", "orientation")
_EVENTS_IN_SIGHT = 120
"""Lanes show so many events around the cursor: callbacks, not a grey bar."""
_LOOP_NS = 5_000_000_000
"""How long it takes to play what is around a divergence."""
_TABLE = ("node", "callback", "kind", "outputs", "cause", "flags", "input_hash", "output_hash")

Part: TypeAlias = Container | View


def blueprint(
    shown: Sequence[Shown],
    marks: DivergenceMarks | None = None,
    distances: Distances | None = None,
    *,
    by_event: bool = False,
) -> rrb.Blueprint:
    """Return the layout for one run, or for two with what was found to differ; it opens on
    simulated time or ``by_event``."""
    world = _world(shown)
    plots = _plots(shown, marks, distances or Distances())
    above: list[Part] = []
    if marks is not None:
        above.append(rrb.TextDocumentView(origin=marks.document, name="What differs"))
    above += [part for part in (world, plots) if part is not None]
    below = rrb.Tabs(*_below(shown, marks), active_tab=int(by_event), name="Run")
    if not above:
        root: Part = below
    else:
        root = rrb.Vertical(rrb.Horizontal(*above), below, row_shares=[3, 2])
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        _time_panel(shown, marks, by_event=by_event),
        auto_views=False,
        auto_layout=False,
    )


def _time_panel(
    shown: Sequence[Shown], marks: DivergenceMarks | None, *, by_event: bool
) -> rrb.TimePanel:
    """Of two runs, the viewer opens on the divergence and plays from there, slowly enough to be
    watched, over and over: a layout can say where a loop begins, but not where a cursor stands."""
    timeline = _order(shown) if by_event else SIM_TIME
    start = None if marks is None else marks.row if by_event else marks.stamp_ns
    if start is None:
        return rrb.TimePanel(state="collapsed", timeline=timeline)
    around = _EVENTS_IN_SIGHT // 2 if by_event else _in_sight_ns(shown)
    return rrb.TimePanel(
        state="collapsed",
        timeline=timeline,
        play_state="playing",
        loop_mode="selection",
        time_selection=rr.encodings.AbsoluteTimeRange(start, start + around),
        playback_speed=1.0 if by_event else min(around / _LOOP_NS, 1.0),
        fps=around * NS_PER_S / _LOOP_NS if by_event else None,
    )


def _order(shown: Sequence[Shown]) -> str:
    return EVENT if len(shown) == 1 else ROW


def _world(shown: Sequence[Shown]) -> Part | None:
    by_root: dict[str, list[str]] = {}
    for run in shown:
        for root, paths in run.seen.frames.by_root().items():
            flat = [p for p in paths if p not in run.seen.images and p not in run.seen.fixes]
            if flat:
                by_root.setdefault(root, []).extend(flat)
    views: list[Part] = [
        rrb.Spatial3DView(
            origin="/",
            contents=_only(paths),
            name=f"3D: {root}" if root else "3D",
            spatial_information=rrb.SpatialInformation(target_frame=root) if root else None,
            eye_controls=_from_above(shown, root, paths),
        )
        for root, paths in by_root.items()
    ]
    fixes = [path for run in shown for path in run.seen.fixes]
    if fixes:
        # Never in front: a map in sight asks a server for its tiles, which tells where one was.
        contents = [f"+ {path}" for fix in fixes for path in (fix, f"{fix}/track")]
        views.append(rrb.MapView(origin="/", contents=contents, name="Map (online)"))
    images: list[Part] = [
        rrb.Spatial2DView(
            origin=path,
            contents="$origin",
            name=f"{run.paths.label} {run.seen.topic_of[path]}".strip(),
        )
        for run in shown
        for path in list(run.seen.images)[:IMAGES_MAX]
    ]
    parts: list[Part] = []
    if views:
        front = [v for v in views if not isinstance(v, rrb.MapView)]
        if front:
            parts.append(rrb.Tabs(*views, active_tab=0) if len(views) > 1 else front[0])
        else:
            parts.append(rrb.Tabs(*views, rrb.TextDocumentView(name="(no frames)"), active_tab=1))
    if images:
        parts.append(rrb.Grid(*images, name="Images"))
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else rrb.Vertical(*parts, row_shares=[2, 1])


def _from_above(
    shown: Sequence[Shown], root: str, paths: Sequence[str]
) -> rrb.EyeControls3D | None:
    """Look down on the tracks that are drawn in the root frame; None if there are none."""
    boxes = [
        run.seen.extents[path]
        for run in shown
        for path in paths
        if path in run.seen.extents and run.seen.frames.frames[path] == root
    ]
    corners = np.array([corner for box in boxes for corner in box if np.isfinite(corner).all()])
    if not len(corners):
        return None
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, size = (low + high) / 2, max(float(np.max(high - low)), 1.0)
    # A little from the south, so that north is up.
    return rrb.EyeControls3D(
        position=centre + np.array((0.0, -0.3, 1.2)) * size, look_target=centre, eye_up=(0, 0, 1)
    )


def _plots(
    shown: Sequence[Shown], marks: DivergenceMarks | None, distances: Distances
) -> Part | None:
    """The same curves of all runs in one plot; the most telling ones at once, the rest in tabs.

    Of two runs, how far they are apart comes first; what is equal in both says nothing.
    """
    fields: dict[Key, list[str]] = {}
    for run in shown:
        for key, path in curve_keys(run).items():
            if key not in distances.equal and not key[0].startswith("/rsltrace/"):
                fields.setdefault(key, []).append(path)
    first = marks.fields if marks is not None else ()
    names = {
        key: " ".join((key[1], *(n for run in shown for n in run.seen.curves.get(paths[0], ()))))
        for key, paths in fields.items()
    }
    arrays = {key for key, name in names.items() if name.endswith("]")}
    for key in arrays.difference(first):
        del fields[key]
    reached = marks.topics if marks is not None else ()
    ranked = sorted(
        fields,
        key=lambda key: (
            _place(key, first),
            key[0] not in reached,
            _rank(key[0], names[key]),
            key,
        ),
    )
    chosen: list[tuple[str, str]] = []
    rest: list[tuple[str, str]] = []
    topics: set[str] = set()
    for key in ranked:
        new = key[0] not in topics or _place(key, first) < len(first)
        (chosen if new and len(chosen) < _PLOTS_SHOWN else rest).append(key)
        topics.add(key[0])
    chosen.sort(key=ranked.index)
    views: list[Part] = [_plot(key, fields[key]) for key in chosen]
    more = [_plot(key, fields[key]) for key in rest[: _PLOTS_MAX - len(views)]]
    if not views:
        return None
    if more:
        views[-1] = rrb.Tabs(views[-1], *more, active_tab=0)
    far = [distances.paths[key] for key in ranked if key in distances.paths]
    if far:
        title = ("Distance between the runs", "")
        views.insert(0, _plot(title, far[:_PLOTS_SHOWN], "LeftTop"))  # it grows to the right
    return views[0] if len(views) == 1 else rrb.Vertical(*views, name="Plots")


def _plot(key: tuple[str, str], paths: list[str], legend: str = "RightTop") -> rrb.TimeSeriesView:
    """Return curves over the whole run, on either timeline."""
    name = f"{key[0]} {key[1]}".strip()
    always = rr.TimeRangeBoundary.infinite()
    return rrb.TimeSeriesView(
        origin="/",
        contents=_only(paths),
        name=name,
        plot_legend=rrb.PlotLegend(corner=legend, visible=True),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=always, end=always)),
    )


def _place(key: tuple[str, str], first: Sequence[tuple[str, str]]) -> int:
    """Return where a field is in the list of those that differ, or behind its end."""
    return first.index(key) if key in first else len(first)


def _rank(topic: str, names: str) -> tuple[bool, bool, int]:
    places = [i for i, name in enumerate(_FIRST_FIELDS) if name in names]
    return (
        topic.startswith(_LAST_TOPICS),
        any(name in names for name in _LAST_FIELDS),
        min(places, default=len(_FIRST_FIELDS)),
    )


def _below(shown: Sequence[Shown], marks: DivergenceMarks | None) -> list[Part]:
    lanes = list(marks.lanes) if marks is not None else []
    logs: list[str] = []
    rates: list[str] = []
    nodes = sorted({name for run in shown for name in run.nodes if name != NO_NODE})[:_LANES_MAX]
    lanes += [run.paths.lane(name) for name in nodes for run in shown if name in run.nodes]
    for run in shown:
        names = sorted(run.nodes, key=lambda name: name == NO_NODE)
        rates += [f"{run.paths.node(name)}/rate" for name in names]
        logs += [f"{run.paths.node(name)}/log" for name in names]
    # A range is in units of one timeline, so there is a panel for each; one is in sight.
    order = _order(shown)
    parts: list[Part] = [
        _lanes(lanes, "Callbacks by time", _in_sight_ns(shown)),
        _lanes(lanes, f"Callbacks by {order}", _EVENTS_IN_SIGHT // 2),
    ]
    if any(run.log_records for run in shown):
        parts.append(
            rrb.TextLogView(
                origin="/",
                contents=_only(logs),
                name="Log",
                columns=rrb.TextLogColumns(
                    timeline_columns=[SIM_TIME, order],
                    text_log_columns=["loglevel", "body"]
                    if len(shown) == 1
                    else ["entitypath", "loglevel", "body"],
                ),
            )
        )
    tables: list[Part] = [_table(run, order) for run in shown]
    parts.append(tables[0] if len(tables) == 1 else rrb.Horizontal(*tables, name="Events"))
    parts.append(rrb.TimeSeriesView(origin="/", contents=_only(rates), name="Callbacks per second"))
    return parts


def _in_sight_ns(shown: Sequence[Shown]) -> int:
    """Return how much simulated time lanes show before the cursor, and as much behind it."""
    return max(_EVENTS_IN_SIGHT * run.mean_gap_ns // 2 for run in shown)


def _lanes(paths: list[str], name: str, around: int) -> rrb.StateTimelineView:
    """Lanes around the cursor, in units of the timeline they are meant for."""
    start, end = (rr.TimeRangeBoundary.cursor_relative(seq=n) for n in (-around, around))
    return rrb.StateTimelineView(
        origin="/",
        contents=_only(paths),
        name=name,
        time_view=rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end)),
    )


def _table(run: Shown, order: str) -> rrb.DataframeView:
    path = run.paths.events
    columns = _TABLE if order == EVENT else (NUMBER, *_TABLE)
    return rrb.DataframeView(
        origin=path,
        contents="$origin",
        name=f"Events {run.paths.label}".strip(),
        query=rrb.archetypes.DataframeQuery(
            timeline=order,
            select=[order, SIM_TIME, *(f"{path}:{name}" for name in columns)],
            auto_scroll=True,
        ),
    )


def _only(paths: Iterable[str]) -> list[str]:
    return [f"+ {path}" for path in paths]
