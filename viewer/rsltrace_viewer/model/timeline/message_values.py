"""A message in a few words, for a row: ``x=0.31 ω=-0.05``, ``360 ranges 0.4–8.9 m``."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from types import MappingProxyType
from typing import Any

import numpy as np

from rsltrace.errors import RsltraceError, TraceError
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.event import NO_SEQUENCE, Output, OutputKind
from rsltrace.trace.model.texts import PLACEHOLDERS, printable, shortened
from rsltrace.trace.words.phrases import TURNS, number
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import EventText, outputs_text

_NOT_SHOWN = PLACEHOLDERS | {"header", "stamp"}
_VALUES_MAX = 5
_LEAVES_MAX = 60
_TEXT_MAX = 30
SAMPLES_MAX = 4
"""Messages of a topic that are read to find out which values vary."""
_BYTES_MAX, _FLAT_BYTES_MAX = 1 << 16, 1 << 24
_FLAT = frozenset(
    f"sensor_msgs/msg/{name}" for name in ("CompressedImage", "Image", "LaserScan", "PointCloud2")
) | {"nav_msgs/msg/OccupancyGrid"}
"""Types with one long array of numbers, which is decoded at once."""
_EMPTY = ("0", "false", '""', "[]")


def message_values(message: object, varying: Collection[str] = ()) -> str:
    """Return a decoded message in a few words.

    ``varying`` are the paths that ``varying_values`` found on its topic: they come first."""
    summary = _SUMMARIES.get(str(getattr(message, "__msgtype__", "")))
    if summary is not None:
        # A type of this name may have other fields, or the same ones with other types.
        with suppress(AttributeError, TypeError, ValueError, IndexError):
            return printable(summary(message)).strip()
    return printable(_values(message, varying))


def too_large(type_name: str, size: int) -> bool:
    """Return whether decoding a message of ``size`` bytes takes too long for a row."""
    return size > (_FLAT_BYTES_MAX if type_name in _FLAT else _BYTES_MAX)


def varying_values(
    type_name: str, payloads: Iterable[bytes | None], decode: Callable[[bytes], object]
) -> frozenset[str]:
    """Return the paths of the values in which messages of one topic differ.

    Nothing is decoded of a type whose summary does not ask. Messages that are missing, too large or
    damaged are left out.
    """
    first: dict[str, str] = {}
    found: set[str] = set()
    for data in payloads if type_name not in _SUMMARIES else ():
        if data is None or too_large(type_name, len(data)):
            continue
        try:
            message = decode(data)
        except RsltraceError:
            continue
        values = dict(islice(_leaves(message, ""), _LEAVES_MAX))
        first = first or values
        found |= {path for path, value in values.items() if first.get(path) != value}
    return frozenset(found)


def samples(count: int, most: int) -> list[int]:
    """Return up to ``most`` numbers of ``count`` messages, from the first to the last."""
    return sorted({*np.linspace(0, count - 1, most).astype(int).tolist()}) if count else []


def _values(message: object, varying: Collection[str] = ()) -> str:
    leaves = list(islice(_leaves(message, ""), _LEAVES_MAX))
    chosen = [leaf for leaf in leaves if leaf[0] in varying or leaf[1] not in _EMPTY] or leaves[:2]
    if len(chosen) > _VALUES_MAX:
        chosen.sort(key=lambda leaf: leaf[0] not in varying)
    # Names of frames and the like rarely change: they come last.
    chosen = sorted(chosen, key=_is_text)[:_VALUES_MAX]
    short = Counter(path.rpartition(".")[2] for path, _ in chosen)
    parts = []
    for path, value in chosen:
        name = path.rpartition(".")[2]
        if short[name] > 1:
            name = ".".join(path.split(".")[-2:])
        parts.append(f"{name}={value}" if len(leaves) > 1 else value)
    return " ".join(parts)


def _is_text(leaf: tuple[str, str]) -> bool:
    return leaf[1].startswith('"')


# What a person wants to know of common messages that are long, or nested.


def _transforms(message: Any) -> str:
    return _first_of(_transform, message.transforms, "transforms")


def _transform(one: Any) -> str:
    frames = f"{_cut(one.header.frame_id) or '?'}→{_cut(one.child_frame_id) or '?'}"
    return f"{frames} {_values(one.transform)}"


def _odometry(message: Any) -> str:
    pose, velocity = message.pose.pose, message.twist.twist
    turned = number(_yaw(*(float(getattr(pose.orientation, axis)) for axis in "xyzw")))
    texts = [*_named("", pose.position), *([f"θ={turned}"] if turned != "0" else ())]
    texts += [*_named("v", velocity.linear), *_named("", velocity.angular, TURNS)]
    return " ".join(texts) or "x=0 y=0"


def _imu(message: Any) -> str:
    turns = _named("", message.angular_velocity, TURNS)
    return " ".join([*turns, *_named("a", message.linear_acceleration)]) or "ω=0 a=0"


def _named(before: str, vector: Any, names: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Return the parts of a vector that are not zero, each with its name."""
    found = ((axis, number(float(getattr(vector, axis)))) for axis in "xyz")
    return [f"{before}{names.get(axis, axis)}={text}" for axis, text in found if text != "0"]


def _fix(message: Any) -> str:
    if message.status.status < 0:
        return "no fix"
    return f"{message.latitude:.6f}°, {message.longitude:.6f}°, {number(message.altitude)} m high"


def _parameters(message: Any) -> str:
    changed = [_cut(one.name) for one in (*message.new_parameters, *message.changed_parameters)]
    deleted = [f"deleted {_cut(one.name)}" for one in message.deleted_parameters]
    return _first_of(str, [*changed, *deleted], "parameters")


def _scan(message: Any) -> str:
    ranges = np.asarray(message.ranges, dtype=np.float64)
    seen = ranges[np.isfinite(ranges)]
    if not len(seen):
        kinds = {"NaN": np.isnan(ranges).any(), "inf": np.isinf(ranges).any()}
        what = " or ".join(kind for kind, there in kinds.items() if there)
        return f"{_count(ranges, 'range')}, all {what}" if what else "no ranges"
    ends = dict.fromkeys(number(end, 3) for end in (seen.min(), seen.max()))
    return f"{_count(ranges, 'range')} {'–'.join(ends)} m"


def _image(message: Any) -> str:
    return f"{message.width}x{message.height} {_cut(message.encoding)}"


def _compressed_image(message: Any) -> str:
    return f"{_cut(message.format)} {len(message.data) / 1e3:,.1f} kB"


def _cloud(message: Any) -> str:
    return _count(range(message.width * message.height), "point")


def _joint_state(message: Any) -> str:
    values = next((v for v in (message.position, message.velocity, message.effort) if len(v)), ())
    texts = [number(float(value)) for value in values]
    if not len(message.name):
        return f"{_joints(texts)}{' (no names)' if texts else ''}"
    names = [_cut(name) for name in message.name]
    named = [f"{name}={text}" for name, text in zip(names, texts, strict=False)]
    return _joints(named or names)


def _trajectory(message: Any) -> str:
    joints = _joints([_cut(name) for name in message.joint_names])
    return f"{_count(message.points, 'point')} for {joints}"


def _path(message: Any) -> str:
    last = f" to {_values(message.poses[-1].pose.position)}" if len(message.poses) else ""
    return f"{_count(message.poses, 'pose')}{last}"


def _grid(message: Any) -> str:
    info = message.info
    return f"{info.width}x{info.height} cells of {number(info.resolution)} m"


def _markers(message: Any) -> str:
    return _count(message.markers, "marker")


def _diagnostics(message: Any) -> str:
    def level(one: Any) -> int:
        return one.level[0] if isinstance(one.level, bytes) else int(one.level)

    def status(one: Any) -> str:
        said = f": {_cut(one.message)}" if one.message else ""
        return f"{_LEVELS[min(level(one), 3)]} {_cut(one.name)}{said}"

    return _first_of(status, sorted(message.status, key=level, reverse=True), "status")


def _first_of(text: Callable[[Any], str], items: Sequence[Any], what: str) -> str:
    more = f" and {len(items) - 1} more" if len(items) > 1 else ""
    return f"{text(items[0])}{more}" if len(items) else f"no {what}"


def _joints(texts: list[str]) -> str:
    more = f" and {len(texts) - _VALUES_MAX} more" if len(texts) > _VALUES_MAX else ""
    return " ".join(texts[:_VALUES_MAX]) + more or "no joints"


def _count(items: Sized, what: str) -> str:
    return f"{len(items):,} {what}{'' if len(items) == 1 else 's'}"


def _cut(text: str) -> str:
    return shortened(text, _TEXT_MAX)


_LEVELS = ("OK", "WARN", "ERROR", "STALE")
_SUMMARIES: dict[str, Callable[[Any], str]] = {
    "diagnostic_msgs/msg/DiagnosticArray": _diagnostics,
    "geometry_msgs/msg/TransformStamped": _transform,
    "nav_msgs/msg/OccupancyGrid": _grid,
    "nav_msgs/msg/Odometry": _odometry,
    "nav_msgs/msg/Path": _path,
    "rcl_interfaces/msg/ParameterEvent": _parameters,
    "sensor_msgs/msg/CompressedImage": _compressed_image,
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/JointState": _joint_state,
    "sensor_msgs/msg/LaserScan": _scan,
    "sensor_msgs/msg/NavSatFix": _fix,
    "sensor_msgs/msg/PointCloud2": _cloud,
    "tf2_msgs/msg/TFMessage": _transforms,
    "trajectory_msgs/msg/JointTrajectory": _trajectory,
    "visualization_msgs/msg/MarkerArray": _markers,
}


def differing_values(a: object, b: object) -> tuple[str, str]:
    """Return the first values in which two decoded messages differ, in full."""
    leaves = [dict(list(_leaves(one, "", in_full=True))[:_LEAVES_MAX]) for one in (a, b)]
    paths = [path for path in leaves[0] if leaves[0][path] != leaves[1].get(path)]
    texts = [
        printable(" ".join(f"{path.rpartition('.')[2]}={one.get(path, '-')}" for path in paths))
        for one in leaves
    ]
    return texts[0], texts[1]


def _leaves(value: Any, path: str, in_full: bool = False) -> Iterator[tuple[str, str]]:
    if isinstance(value, (bool, np.bool_)):
        yield path, "true" if value else "false"
    elif isinstance(value, (int, np.integer)):
        yield path, str(value)
    elif isinstance(value, (float, np.floating)):
        yield path, repr(float(value)) if in_full else number(float(value))
    elif isinstance(value, str):
        yield path, f'"{shortened(value, _TEXT_MAX)}"'
    elif isinstance(value, (list, np.ndarray)):
        if in_full:
            for place, item in enumerate(value[:_LEAVES_MAX]):
                yield from _leaves(item, f"{path}[{place}]", in_full)
        elif "covariance" not in path:
            yield path, _items(value)
    elif dataclasses.is_dataclass(value):
        yield from _fields(value, path, in_full)


def _fields(message: Any, path: str, in_full: bool) -> Iterator[tuple[str, str]]:
    left_out = PLACEHOLDERS if in_full else _NOT_SHOWN
    names = [f.name for f in dataclasses.fields(message) if f.name not in left_out]
    if names == ["x", "y", "z", "w"] and not in_full:  # a quaternion: its turn is what tells
        yield f"{path}.θ".lstrip("."), number(_yaw(*(float(getattr(message, n)) for n in names)))
        return
    turns = "angular" in path and names == ["x", "y", "z"]
    for name in names:
        inner = TURNS[name] if turns else name.rstrip("_")
        yield from _leaves(getattr(message, name), f"{path}.{inner}".lstrip("."), in_full)


def _items(values: Any) -> str:
    if not len(values):
        return "[]"
    if len(values) <= 3 and not dataclasses.is_dataclass(values[0]):
        return "[" + " ".join(value for item in values for _, value in _leaves(item, "")) + "]"
    return f"[{_count(values, 'item')}]"  # [5] is an array of one five


def _yaw(x: float, y: float, z: float, w: float) -> float:
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


# What events sent and got, with values, for rows. Read separately from the rows: messages have to
# be decoded for it, and the first of each type takes as long as a screen may.

_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_OUTPUTS_MAX = 12
_KEPT = 4096


class RowValues:
    """The texts of one run's events that have been read so far."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._texts: OrderedDict[int, str] = OrderedDict()
        self._events: dict[int, EventText] = {}
        self._varying: dict[int, frozenset[str]] = {}
        """By channel, the paths of the values that vary."""

    def known(self, event: EventText) -> EventText:
        """Return an event with the values of what it did, if these have been read."""
        text = self._texts.get(event.index)
        if not text:
            return event
        found = self._events.get(event.index)
        if found is None:
            found = self._events[event.index] = replace(event, outputs=text)
        return found

    def read(self, indexes: Sequence[int]) -> Iterator[int]:
        """Read events, one at a time; yields how many are done."""
        for count, index in enumerate(indexes, start=1):
            if index not in self._texts:
                self._texts[index] = self._text(index)
                while len(self._texts) > _KEPT:
                    self._events.pop(self._texts.popitem(last=False)[0], None)
            yield count

    def _text(self, index: int) -> str:
        run = self._run
        try:
            event = run.event(index)
            outputs = run.outputs(index)
            if any(output.kind is not OutputKind.DRAW for output in outputs):
                budget = iter(range(_OUTPUTS_MAX))
                return outputs_text(
                    run, outputs, more=lambda o: "" if next(budget, None) is None else self._of(o)
                )
            source = run.input_of(event)
            if source is None or source.kind not in _MESSAGES:
                return ""
            values = self._of(source)
            drawn = outputs_text(run, outputs)
            return ", ".join(filter(None, (values and f"got {values}", drawn)))
        except TraceError:
            return ""  # the row says what is wrong, without values

    def _of(self, output: Output) -> str:
        if output.kind not in _MESSAGES or output.sequence == NO_SEQUENCE:
            return ""
        trace = self._run.trace
        try:
            found = trace.payload(output)
            channel = trace.channel_of(output)
            if found is None or channel is None:
                return ""
            if too_large(channel.type, len(found[2])):
                return f"({len(found[2]) / 1e6:.1f} MB)"
            return message_values(
                trace.decode(channel, found[2]), self._varying_of(channel, output)
            )
        except TraceError:
            return ""

    def _varying_of(self, channel: ChannelInfo, output: Output) -> frozenset[str]:
        trace = self._run.trace
        known = self._varying.get(channel.id)
        if known is None:
            numbers = samples(trace.message_counts.get(channel.id, 0), SAMPLES_MAX)
            found = (trace.payload(replace(output, sequence=number)) for number in numbers)
            known = self._varying[channel.id] = varying_values(
                channel.type,
                (one and one[2] for one in found),
                lambda data: trace.decode(channel, data),
            )
        return known
