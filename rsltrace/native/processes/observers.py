"""All that observes a process, and a thread that tells the run of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from ctypes import (
    CDLL,
    POINTER,
    Structure,
    byref,
    c_bool,
    c_char_p,
    c_int64,
    c_size_t,
    c_ubyte,
    c_uint64,
    c_void_p,
    string_at,
)
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from rsltrace.native.callback_observer import CallbackObserver
from rsltrace.native.message_observer import MessageObserver
from rsltrace.native.node_observer import NodeObserver
from rsltrace.native.observed_entities import ObservedEntities
from rsltrace.native.processes.wire import Link, SpanEncoder
from rsltrace.native.span_recorder import RunningCallback, SpanRecorder
from rsltrace.native.support import Patience
from rsltrace.trace.native import CUT_AFTER_NS

# Which publisher a message is from: what rcl knows and rclpy does not tell.
#
# A message is taken as rclpy takes it, by rcl, and made into a Python object by rclpy's own
# extension; in between there is its header, with the publisher's gid.

_OK, _NOTHING_THERE = 0, 401
_NO_NUMBER = 2**64 - 1


class _Gid(Structure):
    _fields_ = (("middleware", c_char_p), ("data", c_ubyte * 16))


class _Info(Structure):
    """``rmw_message_info_t``, and room for what releases to come may add."""

    _fields_ = (
        ("source_ns", c_int64),
        ("received_ns", c_int64),
        ("publication", c_uint64),
        ("reception", c_uint64),
        ("gid", _Gid),
        ("from_this_process", c_bool),
        ("room", c_ubyte * 256),
    )


class _Allocator(Structure):
    _fields_ = tuple((name, c_void_p) for name in ("new", "free", "more", "zeros", "state"))


class _Bytes(Structure):
    _fields_ = (
        ("data", c_void_p),
        ("length", c_size_t),
        ("capacity", c_size_t),
        ("allocator", _Allocator),
    )


class PublisherGids:
    """Asks rcl. ``extension`` is rclpy's."""

    def __init__(self, extension: Any, rcl: Any) -> None:
        self._extension = extension
        self._rcl = rcl
        self._local = threading.local()
        self._take = rcl.rcl_take_serialized_message
        self._take.argtypes = (c_void_p, POINTER(_Bytes), POINTER(_Info), c_void_p)
        self._handle_of = rcl.rcl_publisher_get_rmw_handle
        self._handle_of.argtypes, self._handle_of.restype = (c_void_p,), c_void_p
        self._gid_of = rcl.rmw_get_gid_for_publisher
        self._gid_of.argtypes = (c_void_p, POINTER(_Gid))
        rcl.rcutils_get_default_allocator.restype = _Allocator
        rcl.rcutils_uint8_array_init.argtypes = (POINTER(_Bytes), c_size_t, POINTER(_Allocator))

    def of_publisher(self, handle: Any) -> bytes:
        """Return the gid of a publisher, by its handle; empty if it is not known."""
        gid = _Gid()
        inner = self._handle_of(handle.pointer)
        if not inner or self._gid_of(inner, byref(gid)) != _OK:
            self._rcl.rcutils_reset_error()
            return b""
        return bytes(gid.data)

    def take(self, handle: Any, type: Any, raw: bool) -> tuple[Any, bytes]:
        """Take a message as a subscription's ``take_message`` does; return what that returns, and
        the gid of the publisher."""
        info, room = _Info(), self._room()
        code = self._take(handle.pointer, byref(room), byref(info), None)
        if code == _NOTHING_THERE:
            self._rcl.rcutils_reset_error()
            return None, b""
        if code != _OK:
            self._rcl.rcutils_reset_error()
            return handle.take_message(type, raw), b""
        data = string_at(room.data, room.length)
        message = data if raw else self._extension.rclpy_deserialize(data, type)
        details = {
            "source_timestamp": info.source_ns,
            "received_timestamp": info.received_ns,
            "publication_sequence_number": _number(info.publication),
            "reception_sequence_number": _number(info.reception),
        }
        return (message, details), bytes(info.gid.data)

    def _room(self) -> _Bytes:
        """Return where this thread takes messages to; it grows with them."""
        try:
            room: _Bytes = self._local.room
        except AttributeError:
            room = self._local.room = _Bytes()
            allocator = self._rcl.rcutils_get_default_allocator()
            self._rcl.rcutils_uint8_array_init(byref(room), 0, byref(allocator))
        return room


def _number(value: int) -> int | None:
    return None if value == _NO_NUMBER else value


def gids(extension: Any) -> PublisherGids | None:
    """Return who asks the librcl that this process has loaded; None if that one cannot be asked."""
    lines = Path("/proc/self/maps").read_text(errors="surrogateescape").splitlines()
    paths = {line.split(maxsplit=5)[-1] for line in lines if "/librcl.so" in line}
    try:
        return PublisherGids(extension, CDLL(paths.pop()))
    except (KeyError, OSError, AttributeError):
        return None


_EVERY_S = 0.05
_WAITS_S = 1.0
_AT_ONCE = 500
"""Spans in one frame, at most."""


class ProcessObservers:
    """Observes this process for good, from ``watch`` on."""

    def __init__(self, extension: Any) -> None:
        found = gids(extension)
        self.recorder = SpanRecorder()
        self.entities = ObservedEntities(self.recorder.add)
        self.message_observer = MessageObserver(
            self.recorder, self.entities, None if found is None else found.take
        )
        self.nodes = (
            NodeObserver(self.entities)
            if found is None
            else NodeObserver(self.entities, found.of_publisher)
        )
        self._extension = extension
        self._stack = ExitStack()

    def watch(self) -> None:
        executors = CallbackObserver(
            self.recorder, self.entities, self.message_observer, self.nodes.meet
        )
        self._stack.enter_context(self.message_observer.watched(self._extension))
        self._stack.enter_context(self.nodes.watched())
        self._stack.enter_context(executors.watched(threads_are_processes=False))

    def forget(self) -> None:
        """Observe nothing any more: this process is a copy of the one that was to be observed."""
        self.recorder.unlock()
        self._stack.close()


class SpanSender(threading.Thread):
    """Tells the run what was observed, again and again, until ``finish``.

    A program may crash as it ends (executors with threads, nodes that are not destroyed): what it
    does then is told at once. Rejected: sending from the thread that did it, where an exception of
    a signal handler could leave half a frame.
    """

    def __init__(
        self, link: Link, observers: ProcessObservers, is_constructed: Callable[[], bool]
    ) -> None:
        super().__init__(name="rsltrace sender", daemon=True)
        self._link = link
        self._observers = observers
        self._writer = SpanEncoder(observers.entities)
        self._is_constructed = is_constructed
        self._has_told = False
        self._over = threading.Event()
        self._asked: SimpleQueue[tuple[RunningCallback | None, threading.Event]] = SimpleQueue()
        self._begun_ns = time.process_time_ns()
        self._own_ns = 0
        """Processor time of this thread."""
        self._lock = threading.Lock()

    def run(self) -> None:
        with suppress(OSError):  # the run is gone, and so is this process in a moment
            while not self._over.is_set():
                under_way, told = None, None
                with suppress(Empty):
                    under_way, told = self._asked.get(timeout=_EVERY_S)
                recorder = self._observers.recorder
                for callback in (under_way, None if told is None else recorder.main):
                    if callback is not None:
                        recorder.cut(callback)
                self._tell(CUT_AFTER_NS)
                self._own_ns = time.thread_time_ns()
                if told is not None:
                    told.set()

    def tell_now(self, under_way: RunningCallback | None = None) -> None:
        """Tell what was observed so far, also of the main and of a callback ``under_way``, and wait
        for it: not for ever, and without taking any lock, since a signal handler that ends the
        program may have interrupted what keeps it."""
        if self._over.is_set() or threading.current_thread() is self:
            return
        told = threading.Event()
        self._asked.put((under_way, told))
        Patience(_WAITS_S).wait(told.wait, told.is_set)

    def tell_at_once(self) -> None:
        """Tell all from now on when it is there."""
        self._observers.recorder.after_each = self.tell_now
        self.tell_now()

    def finish(self) -> None:
        """Tell all that is left; of callbacks that still run, as far as they have come."""
        self._over.set()
        with suppress(OSError):
            self._tell(None)

    def _tell(self, patience_ns: int | None) -> None:
        with self._lock:
            if not self._has_told and self._is_constructed():
                self._has_told = True
                self._link.send("constructed")
            recorder, writer = self._observers.recorder, self._writer
            spans, until_ns = recorder.finished_until(patience_ns)
            definitions = writer.definitions()
            counts = (
                recorder.count,
                recorder.activity_ns,
                self._observers.message_observer.unreadable,
                time.process_time_ns() - self._begun_ns,
                self._own_ns,
            )
            parts = [spans[at : at + _AT_ONCE] for at in range(0, len(spans), _AT_ONCE)]
            for number, part in enumerate(parts or [[]]):
                upto_ns = until_ns if number >= len(parts) - 1 else part[-1].start_ns
                plain_spans = [writer.plain(span) for span in part]
                self._link.send(
                    "spans", upto_ns, counts, definitions if number == 0 else [], plain_spans
                )
