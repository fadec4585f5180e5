"""Write a layout for Foxglove and Lichtblick: panels for what is in a trace.

Both import a JSON object with the panels' settings by id (``configById``) and how they divide the
screen (``layout``). They do not read events and outputs, whose chunks have no message index; the
other messages of rsltrace they do.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rsltrace.errors import OutputError, TraceError
from rsltrace.trace.format import PREFIX_OWN, TOPIC_EVENTS, TOPIC_OUTPUTS, TOPIC_ROSOUT
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.model.regular_file import check_output_file, replacement_of
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.recordings.export import chosen_channels

_SAMPLES = 40
"""Messages of a topic that are read to find out what varies."""
_BYTES_MAX = 1 << 20
"""Larger ones are not decoded."""
_FIELDS_MAX = 60
_ITEMS_MAX = 6
_SERIES_MAX = 6
_STATES_MAX = 12
_VALUES_MAX = 8
_PLOTS_PER_TAB, _TABS_MAX, _RAW_MAX = 4, 8, 20

_TF = "tf2_msgs/msg/TFMessage"
_DRAWN = frozenset(
    f"{package}/msg/{name}"
    for package, names in (
        ("geometry_msgs", "PolygonStamped PoseArray PoseStamped PoseWithCovarianceStamped"),
        ("nav_msgs", "GridCells OccupancyGrid Odometry Path"),
        ("sensor_msgs", "LaserScan PointCloud2"),
        ("visualization_msgs", "Marker MarkerArray"),
    )
    for name in names.split()
)
_STATE_TYPES = frozenset(("bool", "string", "int8", "uint8", "byte", "char"))
_NOT_PLOTTED = frozenset(("sec", "nanosec", "frame_id", "child_frame_id"))
_UNPLOTTED = NODE_TOPICS | {"/clock"}
_BARE_TOPIC = re.compile(r"[A-Za-z0-9_/-]+", re.ASCII)


def export_layout(
    trace: Path,
    output: Path,
    *,
    topics: Sequence[str] = ("*",),
    exclude: Sequence[str] = (),
    force: bool = False,
) -> int:
    """Write a layout for a trace to the file ``output``; return the number of its panels.

    ``topics`` and ``exclude`` are globs. Panels: plots of numbers that vary, state transitions, 3D
    where something can be drawn, the log, and raw messages of rsltrace.

    :raises TraceError: if the trace cannot be read.
    :raises OutputError: if the file exists (without ``force``) or cannot be written.
    """
    check_output_file(output, [trace], force=force, example="layout.json")
    with Trace.open(trace) as opened:
        panels = _Panels()
        layout = _arranged(opened, chosen_channels(opened, topics, exclude), panels)
    document = {
        "configById": panels.configs,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }
    text = json.dumps(document, indent=1).replace("<", "\\u003c")  # also within a page
    try:
        with replacement_of(output) as work, work.open("x", encoding="utf-8") as file:
            file.write(f"{text}\n")
    except OSError as error:
        raise OutputError(f"{output} cannot be written: {error.strerror or error}") from error
    return sum(not name.startswith("Tab!") for name in panels.configs)


@dataclass(slots=True)
class _Panels:
    configs: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(self, kind: str, title: str = "", **config: Any) -> str:
        name = f"{kind}!rsltrace{len(self.configs)}"
        if title:  # each program has a key of its own
            config |= {"foxglovePanelTitle": title, "lichtblickPanelTitle": title}
        self.configs[name] = config
        return name

    def tabs(self, tabs: Sequence[tuple[str, Any]]) -> Any:
        """Return the only layout, or a panel with a tab for each."""
        if len(tabs) == 1:
            return tabs[0][1]
        listed = [{"title": title, "layout": layout} for title, layout in tabs]
        return self.add("Tab", activeTabIdx=0, tabs=listed)


def _split(direction: str, layouts: Sequence[Any]) -> Any:
    """Return layouts side by side (``row``) or below each other (``column``), of equal size."""
    first, *rest = layouts
    if not rest:
        return first
    return {
        "direction": direction,
        "first": first,
        "second": _split(direction, rest),
        "splitPercentage": 100 / len(layouts),
    }


def _arranged(trace: Trace, channels: Sequence[ChannelInfo], panels: _Panels) -> Any:
    plots, states, drawn = [], [], []
    frames = _Frames()
    for channel in channels:
        count = trace.message_counts.get(channel.id, 0)
        if not count or channel.topic in _UNPLOTTED:
            continue
        messages = list(_samples(trace, channel, count))
        if channel.type in _DRAWN or channel.type == _TF:
            drawn.append(channel.topic)
            frames.add(messages)
        varying = list(_varying(trace, channel, messages))
        series = [path for path, _, is_plotted in varying if is_plotted][:_SERIES_MAX]
        if series:
            plots.append((printable(channel.topic), series))
        states += [path for path, is_state, _ in varying if is_state]
    left, right = [], []
    if drawn:
        left.append(_scene(panels, drawn, frames.root))
    raw = []
    for topic in _own_topics(trace):
        title = printable(topic.removeprefix(PREFIX_OWN))
        raw.append((title, panels.add("RawMessages", topicPath=_path(topic))))
    if raw:
        left.append(panels.tabs(raw))
    made = [
        panels.add("Plot", title, paths=[_series(one) for one in series], isSynced=True)
        for title, series in plots[: _PLOTS_PER_TAB * _TABS_MAX]
    ]
    pages = [made[at : at + _PLOTS_PER_TAB] for at in range(0, len(made), _PLOTS_PER_TAB)]
    if pages:
        titled = [(f"plots {n}", _split("column", one)) for n, one in enumerate(pages, 1)]
        right.append(panels.tabs(titled))
    if states:
        shown = [_series(one) for one in states[:_STATES_MAX]]
        right.append(panels.add("StateTransitions", paths=shown, isSynced=True))
    if any(channel.topic == TOPIC_ROSOUT for channel in channels):
        right.append(
            panels.add("RosOut", topicToRender=TOPIC_ROSOUT, searchTerms=[], minLogLevel=1)
        )
    sides = [_split("column", side) for side in (left, right) if side]
    return _split("row", sides or [panels.add("SourceInfo")])


def _own_topics(trace: Trace) -> list[str]:
    """Return the topics of rsltrace that have messages which the programs read."""
    counts = trace.message_counts
    found = {one.topic for one in trace.channels.values() if counts.get(one.id)}
    read = {topic for topic in found if topic.startswith(PREFIX_OWN)}
    return sorted(read - {TOPIC_EVENTS, TOPIC_OUTPUTS})[:_RAW_MAX]


def _scene(panels: _Panels, topics: Sequence[str], frame: str) -> str:
    config: dict[str, Any] = {
        "followMode": "follow-none",
        "topics": {topic: {"visible": True} for topic in topics},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid",
                "instanceId": "grid",
                "label": "Grid",
                "visible": True,
                "frameLocked": True,
            }
        },
    }
    if frame:
        config["followTf"] = frame
    return panels.add("3D", **config)


class _Frames:
    """The coordinate frames of messages."""

    def __init__(self) -> None:
        self._parents: dict[str, None] = {}
        self._children: set[str] = set()
        self._others: dict[str, None] = {}

    def add(self, messages: Sequence[Any]) -> None:
        """Add the frames in the headers and transforms of messages."""
        for message in messages:
            for one in getattr(message, "transforms", ()):
                with suppress(AttributeError):
                    self._parents[str(one.header.frame_id)] = None
                    self._children.add(str(one.child_frame_id))
            with suppress(AttributeError):
                self._others[str(message.header.frame_id)] = None

    @property
    def root(self) -> str:
        """The first frame without parent; else the first in a header; "" if there is none."""
        roots = (one for one in self._parents if one not in self._children)
        return next((one for one in (*roots, *self._others) if one), "")


def _samples(trace: Trace, channel: ChannelInfo, count: int) -> Iterator[Any]:
    """Yield messages of a channel, from the first to the last, without those it cannot decode."""
    for number in np.unique(np.linspace(0, count - 1, _SAMPLES).astype(int)).tolist():
        with suppress(TraceError):
            _, data = trace.message(channel.id, number)
            if len(data) <= _BYTES_MAX:
                yield trace.decode(channel, data)


def _varying(
    trace: Trace, channel: ChannelInfo, messages: Sequence[Any]
) -> Iterator[tuple[str, bool, bool]]:
    """Yield the paths of the fields that vary, whether one is a state, and whether a number."""
    try:
        fields = trace.leaves(channel.topic)[:_FIELDS_MAX] if messages else []
    except TraceError:
        return
    for one in fields:
        name = one.name.removesuffix("[]")
        if "[]" in name or one.length_max is not None or _NOT_PLOTTED & {*name.split(".")}:
            continue
        is_state = one.type in _STATE_TYPES
        for number in range(_ITEMS_MAX) if name != one.name else (None,):
            values = [_value(message, name, number) for message in messages]
            different = {repr(value) for value in values if value is not None}
            if len(different) < 2:
                continue
            place = "" if number is None else f"[{number}]"
            few = is_state and number is None and len(different) <= _VALUES_MAX
            is_number = one.type not in ("", "string", "bool")
            yield f"{_path(channel.topic)}.{name}{place}", few, is_number and not few


def _value(message: Any, name: str, number: int | None) -> object:
    """Return a value of a message, None if it is not there."""
    for part in name.split("."):
        message = getattr(message, part, getattr(message, f"{part}_", None))
    if number is None or message is None:
        return message
    return message[number] if number < len(message) else None


def _path(topic: str) -> str:
    """Return a topic as the beginning of a message path: quoted if it is no usual name."""
    if _BARE_TOPIC.fullmatch(topic):
        return topic
    return '"' + re.sub(r'(["\\])', r"\\\1", topic) + '"'


def _series(path: str) -> dict[str, Any]:
    return {"value": path, "enabled": True, "timestampMethod": "receiveTime"}
