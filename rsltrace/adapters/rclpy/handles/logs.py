"""Log records: stamped with simulated time, printed, and published on /rosout."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle
from rsltrace.guard.addresses import report_address_in_text
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.qos.policies import (
    Durability,
    History,
    Liveliness,
    Qos,
    Reliability,
)
from rsltrace.terminal import tell
from rsltrace.trace.cdr import log_content
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import TOPIC_ROSOUT
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import NS_PER_S, format_seconds

_SEVERITY = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
_TEN_SECONDS_NS = 10 * NS_PER_S

_SHARED = (
    "Publisher already registered for node name: '{0}'. If this is due to multiple nodes with the "
    "same name then all logs for the logger named '{0}' will go out over the existing publisher. "
    "As soon as any node with that name is destructed it will unregister the publisher, preventing "
    "any further logs for that name from being published on the rosout topic."
)

QOS_ROSOUT = Qos(
    history=History.KEEP_LAST,
    depth=1000,
    reliability=Reliability.RELIABLE,
    durability=Durability.TRANSIENT_LOCAL,
    deadline_ns=0,
    lifespan_ns=_TEN_SECONDS_NS,
    liveliness=Liveliness.AUTOMATIC,
    lease_ns=0,
)
"""``rmw_qos_profile_rosout_default``."""


class RosoutHandle(PublisherHandle):
    """A node's own publisher of /rosout."""

    output_kind = int(OutputKind.LOG)

    def refuse(self, refusal: Callable[[object], NoReturn]) -> None:
        """Ignore it: a node logs even after its context is shut down."""


class RosoutLogs:
    """Prints log records and publishes them on the node's /rosout publisher."""

    def __init__(self, domain: Domain, *, base_dir: Path, echo: bool) -> None:
        self._domain = domain
        self._base_dir = base_dir
        self.echo = echo
        self._nodes: dict[str, list[NodeHandle]] = {}
        self._files: dict[str, str] = {}

    @cached_property
    def _record(self) -> Any:
        from rcl_interfaces.msg import Log

        return Log()

    def attach(self, node: NodeHandle, qos: Any = None) -> None:
        """Give a node its /rosout publisher. As in rcl, nodes with the same name in one process
        share that of the first."""
        from rcl_interfaces.msg import Log

        name = node.logger_name()
        same = self._nodes.setdefault(name, [])
        if any(one.process is node.process and one.context.ok() for one in same):
            if self.echo:
                self._print(
                    30, self._domain.loop.now_ns, "rcl.logging_rosout", _SHARED.format(name)
                )
            return
        node.rosout = RosoutHandle(node, Log, TOPIC_ROSOUT, QOS_ROSOUT if qos is None else qos)
        same.append(node)

    def detach(self, node: NodeHandle) -> None:
        """Forget a node, and the publisher that it shares with others."""
        same = self._nodes.get(node.logger_name(), [])
        for one in [one for one in same if one.process is node.process]:
            same.remove(one)
            if one is not node and one.context.ok() and one.rosout is not None:
                one.rosout.destroy()

    def add_sublogger(self, name: str, child: str) -> bool:
        """Let a child logger publish through its node; False if the node has no /rosout."""
        nodes = self._nodes.get(name)
        if nodes:
            self._nodes[f"{name}.{child}"] = nodes
        return bool(nodes)

    def log(
        self, severity: int, name: str, message: Any, function: str, file: str, line: int
    ) -> None:
        """Take one record. Severity, name and message are hashed, line numbers are not."""
        if type(message) is not str:
            message = _text(message)
        if not message.isascii():  # lone surrogates are escaped
            message = message.encode(errors="backslashreplace").decode()
        if " at 0x" in message:
            report_address_in_text(message)
        now_ns = self._domain.loop.now_ns
        severity = int(severity)
        if self.echo:
            self._print(severity, now_ns, name, message)
        nodes, node = self._nodes.get(name), self._domain.event.node
        if nodes:
            process = getattr(node, "process", None)
            node = next((one for one in nodes if one.process is process), nodes[0])
        rosout = getattr(node, "rosout", None)
        if rosout is None or rosout.destroyed:
            return
        # Set the slots: the serializer checks the values.
        record = self._record
        stamp = record._stamp
        stamp._sec, stamp._nanosec = divmod(now_ns, NS_PER_S)
        record._level, record._name, record._msg = severity, name, message
        record._file = self._files.get(file) or self._portable(file)
        record._function, record._line = function, line
        data = rosout._serialize(record)
        rosout.send(data, hash64(log_content(data)))

    def show(self, severity: int, name: str, message: str) -> None:
        if self.echo:
            self._print(severity, self._domain.loop.now_ns, name, message)

    def _print(self, severity: int, now_ns: int, name: str, message: str) -> None:
        """Print a record; a closed stderr (``2>&1 | head``) does not affect the run."""
        label = _SEVERITY.get(severity, str(severity))
        try:
            tell(f"[{label}] [{format_seconds(now_ns)}] [{name}]: {message}")
        except (OSError, ValueError, AttributeError):  # gone, closed, or never there
            self.echo = False

    def _portable(self, file: str) -> str:
        """Return a source path that does not depend on where the job's folder is."""
        path = Path(file)
        for base in (self._base_dir, Path(sys.prefix)):
            if path.is_relative_to(base):
                path = path.relative_to(base)
                break
        else:
            path = Path(path.name)
        return self._files.setdefault(file, str(path))


def _text(message: object) -> str:
    """Convert a message that is not a plain str as rclpy's extension does."""
    if isinstance(message, str):  # of a subclass
        return str.__str__(message)
    if message is None:
        return "(null)"
    if isinstance(message, bytes):
        return message.decode(errors="backslashreplace")
    raise TypeError(f"a log message is a str, not a {type(message).__qualname__}")
