"""The floor: the callbacks of nodes in a bare loop of Python.

The nodes are rclpy's own and unchanged, but their ``publish`` puts a copy of the message for each
subscription into one queue, a call of a service goes the same way, and timers stand in a heap.
There is no serializing, no QoS, no order but first come first served, no clock, no recording.
"""

from __future__ import annotations

import copy
import heapq
from collections import deque
from collections.abc import Callable
from functools import partial
from time import perf_counter, process_time
from typing import Any

Ready = deque[tuple[Callable[[Any], Any], Any]]
_IMMUTABLE = (int, float, str, bool, bytes)


def copier(message_class: type) -> Callable[[Any], Any]:
    """Return what copies a message, field by field, without the checks of its constructor."""
    slots = [slot for slot in message_class.__slots__ if slot != "_check_fields"]

    def copied(message: Any) -> Any:
        new = object.__new__(message_class)
        for slot in slots:
            value = getattr(message, slot)
            setattr(new, slot, value if isinstance(value, _IMMUTABLE) else copy.deepcopy(value))
        return new

    return copied


def _publish(ready: Ready, copied: Callable[[Any], Any], callbacks: list[Any], message: Any) -> Any:
    for callback in callbacks:
        ready.append((callback, copied(message)))


def _call(
    ready: Ready, service: Any, request_of: Callable[[Any], Any], response_of: Any, request: Any
) -> Any:
    from rclpy.task import Future

    future: Any = Future()

    def serve(asked: Any) -> None:
        response = service.callback(asked, service.srv_type.Response())
        ready.append((future.set_result, response_of(response)))

    ready.append((serve, request_of(request)))
    return future


def join(nodes: list[Any]) -> tuple[Ready, list[tuple[int, int, Any]]]:
    """Take over what nodes publish and call; return the queue, and the heap of their timers."""
    ready: Ready = deque()
    listeners: dict[str, list[Any]] = {}
    services = {service.srv_name: service for node in nodes for service in node.services}
    for node in nodes:
        for subscription in node.subscriptions:
            listeners.setdefault(subscription.topic_name, []).append(subscription.callback)
    for node in nodes:
        for publisher in node.publishers:
            callbacks = listeners.get(publisher.topic_name, [])
            copied = copier(publisher.msg_type)
            publisher.publish = partial(_publish, ready, copied, callbacks)
        for client in node.clients:
            kind = client.srv_type
            copies = copier(kind.Request), copier(kind.Response)
            client.service_is_ready = lambda: True
            client.call_async = partial(_call, ready, services[client.srv_name], *copies)
    timers = [timer for node in nodes for timer in node.timers]
    heap = [(timer.timer_period_ns, order, timer) for order, timer in enumerate(timers)]
    heapq.heapify(heap)
    return ready, heap


def run_bare(
    nodes: Callable[[], list[Any]], native_args: tuple[str, ...], count: int
) -> dict[str, Any]:
    """Run nodes for about ``count`` callbacks; return their number and the time they took."""
    import rclpy

    rclpy.init(args=list(native_args))
    made = nodes()
    ready, heap = join(made)
    take, replace = ready.popleft, heapq.heapreplace
    before = sum(node.callbacks for node in made)
    start, cpu_start = perf_counter(), process_time()
    left = count
    while left > 0:
        if ready:
            callback, message = take()
            callback(message)
            left -= 1
            continue
        deadline, order, timer = heap[0]
        if timer.is_canceled():
            heapq.heappop(heap)
            continue
        timer.callback()
        replace(heap, (deadline + timer.timer_period_ns, order, timer))
        left -= 1
    times = {"wall_s": perf_counter() - start, "cpu_s": process_time() - cpu_start}
    assert sum(node.callbacks for node in made) > before
    return {"callbacks": count - left} | times
