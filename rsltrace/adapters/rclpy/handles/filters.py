"""Which callback stands behind a subscription of ROS's ``message_filters``, for the trace."""

from __future__ import annotations

from typing import Any

from rsltrace.simulation.middleware.entity import callback_name
from rsltrace.simulation.middleware.interface import callback_source


def filter_detail(callback: object) -> dict[str, object]:
    """Return the synchronizer's callback and how far apart stamps may be, if ``callback`` is that
    of a ``message_filters.Subscriber`` which is an input of a synchronizer."""
    subscriber = getattr(callback, "__self__", None)
    if type(subscriber).__module__.partition(".")[0] != "message_filters":
        return {}
    for add, *_ in getattr(subscriber, "callbacks", {}).values():
        synchronizer: Any = getattr(add, "__self__", None)
        if hasattr(synchronizer, "input_connections") and synchronizer.callbacks:
            function = next(iter(synchronizer.callbacks.values()))[0]
            slop_ns = getattr(getattr(synchronizer, "slop", None), "nanoseconds", 0)
            name, source = callback_name(function), callback_source(function)
            return {"filter": {"callback": name, "source": source, "slop_ns": slop_ns}}
    return {}
