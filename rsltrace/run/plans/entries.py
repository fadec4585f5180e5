"""Import the nodes and hooks of a job, and parse their arguments."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from inspect import Parameter
from typing import Any

from rsltrace.adapters.rclpy.arguments import InvalidArgumentsError, RosArguments
from rsltrace.adapters.rclpy.entry import JobEntry, StartRule, TypedInput, ros_arguments
from rsltrace.adapters.rclpy.hints import parameter_in
from rsltrace.adapters.rclpy.messages.interfaces import get_service_class
from rsltrace.errors import JobError, RunError, SetupError, did_you_mean
from rsltrace.fast_dataclass import dataclass
from rsltrace.job import Job, NodeSpec, locate, policy_of, showing_line
from rsltrace.job.job import entry_meant
from rsltrace.job.values.checks import Target, target_text
from rsltrace.job.values.problem import Loc
from rsltrace.run.plans.executables import MainFinder
from rsltrace.run.plans.processes import ProcessPrograms
from rsltrace.run.plans.scheduling import load_target
from rsltrace.simulation.middleware.graph import Graph
from rsltrace.simulation.middleware.participant import full_name
from rsltrace.trace.model.regular_file import not_regular
from rsltrace.trace.model.texts import format_duration

# Components of a job: loaded by a request to their container, as ``ros2 launch`` does it.

_TYPE = "composition_interfaces/srv/LoadNode"
_RULES = ("-r", "--remap")


@dataclass(frozen=True, slots=True)
class Component:
    """A component to load. ``arguments`` are those of ``ros2 run``; ``name`` and ``namespace`` are
    empty if the component names itself."""

    package: str
    plugin: str
    container: str
    name: str
    namespace: str
    arguments: Sequence[RosArguments]
    extra: Mapping[str, Any]
    log_failure: bool = False

    @property
    def service(self) -> str:
        return load_service(self.container)

    def load(self) -> list[Any]:
        """Load it and wait for the response; return no nodes.

        :raises RunError: if the container cannot load it, unless ``log_failure``.
        """
        import rclpy

        name = "_load" + self.container.replace("/", "_")
        node = rclpy.create_node(name, start_parameter_services=False)
        client = node.create_client(_service_class(), self.service)
        client.wait_for_service()
        future = client.call_async(self._request())
        rclpy.spin_until_future_complete(node, future)
        answer: Any = future.result()
        if not answer.success:
            wrong = (
                f"{self.container} cannot load {self.package}/{self.plugin}: {answer.error_message}"
            )
            if not self.log_failure:
                raise RunError(wrong)
            node.get_logger().error(wrong)
        node.destroy_node()
        return []

    def _request(self) -> Any:
        return _service_class().Request(
            package_name=self.package,
            plugin_name=self.plugin,
            node_name=self.name,
            node_namespace=self.namespace,
            remap_rules=list(dict.fromkeys(self._rules())),
            parameters=_messages(self._parameters()),
            extra_arguments=_messages(self.extra),
        )

    def _rules(self) -> Iterable[str]:
        """Return the remappings, except for the node's own name."""
        for part in self.arguments:
            for flag, rule in zip(part.arguments, part.arguments[1:], strict=False):
                if flag in _RULES and not rule.startswith(("__node:=", "__ns:=", "__name:=")):
                    yield rule

    def _parameters(self) -> dict[str, Any]:
        node = full_name(self.namespace, self.name) if self.name else ""
        values: dict[str, Any] = {}
        for part in self.arguments:
            values.update(part.parameters(node))
        return values


def load_service(container: str) -> str:
    """Return the name of the service by which a container loads components."""
    return f"{container}/_container/load_node"


def check_loadable(where: str) -> None:
    """Raise ``JobError`` if the service type for loading components is not installed."""
    try:
        _service_class()
    except SetupError as error:
        raise JobError(str(error), where=where) from error


def _service_class() -> Any:
    return get_service_class(_TYPE)


def _messages(values: Mapping[str, Any]) -> list[Any]:
    """Return parameters in the order of their names: a trace keeps no other one of its job."""
    from rclpy.parameter import Parameter

    return [Parameter(name, value=values[name]).to_parameter_msg() for name in sorted(values)]


def impossible_starts(job: Job, graph: Graph, start_ns: int, end_ns: int | None) -> Iterator[str]:
    """Yield the entries that can never start, judging by the complete graph.

    ``end_ns`` is when the run ends, if time ends it.
    """
    topics = [name for name, _ in graph.topic_names_and_types() if graph.publishers(name)]
    services = [name for name, _ in graph.service_names_and_types() if graph.services(name)]
    nodes = [node.fully_qualified_name for node in graph.nodes]
    for index, spec in enumerate(job.nodes):
        if spec.container is not None and load_service(spec.container) not in services:
            near = did_you_mean(spec.container, nodes)
            yield (
                f"{_where(job, index, 'container')}: {spec.target} is never loaded: there is no "
                f"container {spec.container}{near}"
            )
        after = spec.start_after
        if after is None:
            continue
        for key, names, missing in (
            ("topic", topics, "{} has no publisher"),
            ("service", services, "{} has no server"),
            ("node", nodes, "no entry makes a node {}"),
        ):
            name = getattr(after, key)
            if name is not None and name not in names:
                why = missing.format(name) + did_you_mean(name, names)
                yield f"{_where(job, index, key)}: {spec.target} never starts: {why}"
        if end_ns is not None and start_ns + after.delay_ns > end_ns:
            yield (
                f"{_where(job, index, 'delay')}: {spec.target} never starts: that is "
                f"{format_duration(after.delay_ns)} after the start, and the run ends "
                f"{format_duration(end_ns - start_ns)} after it"
            )


def missed_starts(job: Job, missed: Iterable[tuple[str, list[str]]]) -> Iterator[str]:
    """Yield the entries (keys) that have not started, and what they waited for."""
    keys = entry_keys(job.nodes)
    for key, unmet in missed:
        index = keys.index(key)
        spec = job.nodes[index]
        after = spec.start_after
        waited = [
            f"{name} {getattr(after, name, None) or _of_container(spec, name)}" for name in unmet
        ]
        if not waited:
            waited = [f"{format_duration(0 if after is None else after.delay_ns)} to pass"]
        place = _where(job, index, unmet[0] if unmet else "delay")
        yield f"{place}: {spec.target} has not started: it waited for {' and '.join(waited)}"


def _of_container(spec: NodeSpec, name: str) -> str:
    """Return what a component implicitly waits for."""
    assert spec.container is not None
    return load_service(spec.container) if name == "service" else "the component before it"


def _where(job: Job, index: int, key: str) -> str:
    spec = job.nodes[index]
    place: Loc = ("nodes", index, "start_after", key)
    if spec.container is not None and spec.start_after is None:
        place = ("nodes", index, "container")
    return spec.origin or locate(job, place)


_ENTER = b"\r"
_KEY = re.compile(r"\x1b(?:\[[0-9;]*[ -/]*[@-~]|O[A-Za-z]|[^\x1b])?|.", re.DOTALL)
"""One key: a character, an escape sequence (arrows, function keys), or Alt and a character."""
_LINE_MAX = 4000


def terminal_input(job: Job, index: int) -> list[TypedInput] | None:
    """Return the input for the terminal of an entry, None if it has none.

    :raises JobError: a file cannot be read, or a line is too long.
    """
    stdin = job.nodes[index].stdin
    if stdin is None:
        return None
    typed: list[TypedInput] = []
    for number, item in enumerate(stdin):
        at_ns = item.at_ns
        if item.file is not None:
            lines = _lines(job, item.file, ("nodes", index, "stdin", number, "file"))
            parts: list[bytes | None] = [line + _ENTER for line in lines]
        elif item.line is not None:
            parts = [item.line.encode() + _ENTER]
        elif item.keys is not None:
            parts = [key.encode() for key in _KEY.findall(item.keys)]
        else:
            parts = [None]
        for part in parts:
            typed.append((at_ns, part))
            at_ns = None
    return typed


def _lines(job: Job, file: str, loc: tuple[str | int, ...]) -> list[bytes]:
    where = locate(job, loc)
    with showing_line(job, loc):
        try:
            lines = job.resolve(file).read_bytes().splitlines()
        except OSError as error:
            raise JobError(f"{file} cannot be read: {error.strerror}", where=where) from None
        for number, line in enumerate(lines, start=1):
            if len(line) > _LINE_MAX:
                raise JobError(
                    f"{file}:{number}: a terminal takes lines of at most {_LINE_MAX} bytes, this "
                    f"one has {len(line)}",
                    where=where,
                )
    return lines


_BY_NAME = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)


def node_entries(
    job: Job,
    only: Container[int] | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> list[JobEntry]:
    """Import what the job names and let rcl parse the arguments; nothing is constructed.

    ``only`` are the wanted places in ``nodes:`` (None: all); ``note`` is called with a line when
    something takes long.
    """
    entries = []
    mains = MainFinder(job)
    processes = ProcessPrograms(job, note)
    for_all = arguments_for_all(job)
    keys = entry_keys(job.nodes)
    for index, (spec, key) in enumerate(zip(job.nodes, keys, strict=True)):
        if only is not None and index not in only:
            continue
        loc = ("nodes", index, spec.kind)
        where = spec.origin or locate(job, loc)
        argv = program = None
        make: Any
        with showing_line(job, loc):
            arguments = arguments_of(job, index, for_all, where=where)
            if spec.node is None and spec.component is None:
                program = processes.find(spec, arguments, where=where)
            if spec.component is not None:
                make = _component(spec, arguments, where).load
            elif program is not None:
                argv, make = list(program.argv), _never
            elif isinstance(spec.arguments, tuple) or spec.node is None:
                name, make = mains.find(spec, where=where)
                argv = [name, *spec.arguments]
            else:
                target = spec.node
                found = load_target(target, where=where) if isinstance(target, str) else target
                _check_arguments(job, index, found)
                make = partial(found, **spec.arguments)
        entries.append(
            JobEntry(
                spec.target,
                make,
                arguments if spec.component is None else [],
                argv=argv,
                log_exceptions=spec.on_exception == "log",
                key=key,
                policy=policy_of(job.guard, spec.guard) if spec.guard is not None else None,
                start_after=start_rule(job, index, keys),
                stdin=terminal_input(job, index),
                program=program,
                is_component=spec.component is not None,
                respawn=None
                if spec.respawn is None
                else (spec.respawn.delay_ns, spec.respawn.times),
                required=spec.required,
            )
        )
    return entries


def _never() -> object:
    raise AssertionError("a process is started, not called")


def _component(spec: NodeSpec, arguments: Sequence[RosArguments], where: str) -> Component:
    """Return the component that a container loads."""
    check_loadable(where)
    assert spec.component is not None
    assert spec.container is not None
    package, _, plugin = spec.component.partition("/")
    return Component(
        package,
        plugin,
        spec.container,
        spec.name or "",
        spec.namespace or "",
        arguments,
        spec.extra_arguments,
        spec.on_exception == "log",
    )


def start_rule(job: Job, index: int, keys: Sequence[str]) -> StartRule | None:
    """Return when an entry starts, None if it starts with the run."""
    spec = job.nodes[index]
    after = spec.start_after

    def key(reference: str | int | None) -> str | None:
        return None if reference is None else keys[entry_meant(job.nodes, reference)]

    rule = None
    if after is not None:
        started, ended = key(after.started), key(after.ended)
        rule = StartRule(after.delay_ns, after.topic, after.service, after.node, started, ended)
    if spec.container is None:
        return rule
    # A component waits for its container, which loads components one by one.
    rule = rule or StartRule()
    before = previous_component(job.nodes, index)
    return replace(
        rule,
        service=rule.service or load_service(spec.container),
        started=rule.started or (None if before is None else keys[before]),
    )


def previous_component(nodes: Sequence[NodeSpec], index: int) -> int | None:
    """Return the place of the component that the same container loads before this one, or None."""
    spec = nodes[index]
    for place in range(index - 1, -1, -1):
        other = nodes[place]
        if (other.container, other.start_after) == (spec.container, spec.start_after):
            return place
    return None


def arguments_of(job: Job, index: int, for_all: list[str], *, where: str) -> list[RosArguments]:
    """Return the ROS arguments of an entry; ``for_all`` are those of all nodes.

    :raises JobError: rcl refuses them, or cannot read a parameter file.
    """
    _check_parameter_files(job, index)
    spec = job.nodes[index]
    return ros_arguments(
        name=spec.name,
        namespace=spec.namespace,
        parameters=spec.parameters,
        parameter_files=[job.resolve(path) for path in spec.parameter_files],
        remappings=spec.remappings,
        where=where,
        for_all=for_all,
    )


def _check_parameter_files(job: Job, index: int) -> None:
    """Raise ``JobError`` at a parameter file that rcl cannot read."""
    spec = job.nodes[index]
    for number, path in enumerate(spec.parameter_files):
        try:
            RosArguments(["--ros-args", "--params-file", str(job.resolve(path))])
        except InvalidArgumentsError as error:
            loc = ("nodes", index, "parameter_files", number)
            where = spec.origin or locate(job, loc)
            said = str(error).partition("Error: ")[2].strip() or str(error)
            with showing_line(job, loc):
                raise JobError(f"{path} is no ROS parameter file: {said}", where=where) from error


def _check_arguments(job: Job, index: int, target: Any) -> None:
    """Raise ``JobError`` if a class or function does not accept its ``arguments``."""
    spec = job.nodes[index]
    assert isinstance(spec.arguments, dict)
    try:
        signature = inspect.signature(target, follow_wrapped=False)
    except (TypeError, ValueError):
        return  # unknown
    names = [name for name, one in signature.parameters.items() if one.kind in _BY_NAME]
    takes_any = any(one.kind is one.VAR_KEYWORD for one in signature.parameters.values())
    for name in spec.arguments:
        if name not in names and not takes_any:
            takes = f"it takes {', '.join(names)}" if names else "it takes none"
            hint = did_you_mean(name, names, takes)
            wrong = f"{spec.target} takes no argument {name!r}: {hint}"
            raise _error_with_line(job, ("nodes", index, "arguments", name), wrong)
    try:
        signature.bind(**spec.arguments)
    except TypeError as error:
        where = locate(job, ("nodes", index, "node"))
        raise JobError(f"{spec.target}: {error}; give it in 'arguments:'", where=where) from error


def _error_with_line(job: Job, loc: Loc, message: str) -> JobError:
    try:
        with showing_line(job, loc):
            raise JobError(message, where=locate(job, loc))
    except JobError as error:
        return error


def entry_keys(nodes: Sequence[NodeSpec]) -> list[str]:
    """Return a key for each entry, stable when other entries are added."""
    met: Counter[tuple[str, str | None, str | None]] = Counter()
    keys = []
    for spec in nodes:
        own = spec.target, spec.namespace, spec.name
        met[own] += 1
        name = " ".join(part for part in own if part)
        keys.append(f"{name} #{met[own]}" if met[own] > 1 else name)
    return keys


def add_job_location(job: Job, entry: JobEntry, error: RunError | None) -> None:
    """Add to a constructor's error the line of the job: that of the refused parameter, or of the
    entry if several are made the same way."""
    if error is None:
        return
    for index, (spec, key) in enumerate(zip(job.nodes, entry_keys(job.nodes), strict=True)):
        if key != entry.key:
            continue
        name = parameter_in(error.__cause__)
        if name in spec.parameters:
            place = spec.origin or locate(job, ("nodes", index, "parameters", name or ""))
            error.args = (f"{error}\n  the job gives it at {place}",)
        elif sum(other.target == spec.target for other in job.nodes) > 1:
            place = spec.origin or locate(job, ("nodes", index))
            error.args = (f"{error}\n  the job names it at {place}",)


def hook_entries(
    job: Job, name: str, target: Target | None, argument: Callable[[], object]
) -> list[JobEntry]:
    """Return a hook of the job, if it has it, as an entry. A hook may return more nodes.

    :raises JobError: it cannot be imported, or does not take its argument.
    """
    if target is None:
        return []
    where = locate(job, ("hooks", name))
    function: Any = load_target(target, where=where) if isinstance(target, str) else target
    title = f"hook {name}: {target_text(target)}"
    given = {"before": "the job", "after": "the list of nodes"}[name]
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        signature = None  # unknown
    try:
        if signature is not None:
            signature.bind(None)
    except TypeError as error:
        wrong = f"{target_text(target)} is called with {given}, as its only argument: {error}"
        raise _error_with_line(job, ("hooks", name), wrong) from None
    return [JobEntry(title, lambda: function(argument()) or [], [], key=title)]


def arguments_for_all(job: Job) -> list[str]:
    """Return the ROS arguments of all nodes, with absolute paths.

    :raises JobError: rcl refuses them.
    """
    with showing_line(job, ("ros_arguments",)):
        return _arguments_for_all(job)


def _arguments_for_all(job: Job) -> list[str]:
    words = list(job.ros_arguments)
    for index, word in enumerate(words[:-1]):
        if word == "--params-file":
            path = job.resolve(words[index + 1])
            words[index + 1] = str(path)
            if path.exists() and (kind := not_regular(path)):  # rcl would wait for its writer
                where = locate(job, ("ros_arguments",))
                raise JobError(f"the parameter file {path} is {kind}", where=where)
    if words:
        try:
            RosArguments(["--ros-args", *words])
        except InvalidArgumentsError as error:
            where = locate(job, ("ros_arguments",))
            forms = "-p [NODE:]NAME:=VALUE, -r FROM:=TO, --params-file FILE"
            message = f"{error}; ROS arguments are written {forms}"
            raise JobError(message, where=where) from None
    return words
