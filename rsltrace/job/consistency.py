"""What must hold between the parts of a job: names, times, paths and options that go together."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.job.fields import JobFields
from rsltrace.job.parts.stop import StopSpec
from rsltrace.job.start_order import start_problems
from rsltrace.job.values.paths import near_path
from rsltrace.job.values.problem import Problem
from rsltrace.job.values.times import format_time


def contradictions(job: JobFields) -> Iterator[Problem]:
    """Yield what is wrong with a job each of whose parts is right, with its place in the job."""
    yield from _something_to_run(job)
    yield from _times_in_order(job)
    yield from _distinct_names(job)
    yield from start_problems(job)
    yield from _bags_end(job)
    yield from _paths_exist(job)
    yield from _bags_progress(job)
    yield from _ties_are_decided_once(job)


def _bags_progress(job: JobFields) -> Iterator[Problem]:
    if job.progress is None:
        return
    if not job.bags:
        yield Problem("there are no bags (bags:) whose progress could be published", ("progress",))
    elif any(bag.loop is True for bag in job.bags):
        yield Problem("a bag that plays forever makes no progress", ("progress",))


def _bags_end(job: JobFields) -> Iterator[Problem]:
    if job.stop != StopSpec():
        return
    for index, bag in enumerate(job.bags):
        if bag.loop is True:
            yield Problem(
                "plays forever, and nothing ends the run: give a 'stop:', or a number of times",
                ("bags", index, "loop"),
            )


def _something_to_run(job: JobFields) -> Iterator[Problem]:
    if not job.nodes and not job.bags and not job.launch:
        place = ("nodes",) if "nodes" in job.model_fields_set else ()
        yield Problem(
            "a job needs at least one node (nodes:), launch file (launch:) or bag (bags:)",
            place,
        )


def _times_in_order(job: JobFields) -> Iterator[Problem]:
    start_ns, construct_ns, stop_ns = job.start_ns, job.construct_time_ns, job.stop.time_ns
    if start_ns is None:
        return
    if construct_ns is not None and construct_ns > start_ns:
        yield Problem(
            f"{format_time(construct_ns)} is after the start "
            f"({format_time(start_ns)}): nodes are constructed before the run starts",
            ("construct_time",),
        )
    if stop_ns is not None and stop_ns < start_ns:
        yield Problem(
            f"{format_time(stop_ns)} is before the start ({format_time(start_ns)}): it is a "
            "simulated time; 'duration' counts from the start",
            ("stop", "time"),
        )


def _distinct_names(job: JobFields) -> Iterator[Problem]:
    first: dict[tuple[str, str], int] = {}
    for index, node in enumerate(job.nodes):
        if node.name is None:
            continue
        key = (node.namespace or "/", node.name)
        if key in first:
            full_name = f"{key[0].rstrip('/')}/{node.name}"
            yield Problem(
                f"{full_name} is already the name of nodes[{first[key]}]: give one of them "
                "another name or namespace",
                ("nodes", index, "name"),
            )
        first.setdefault(key, index)


def _near(job: JobFields, path: str) -> str:
    """Say what there is instead of a path that does not lead anywhere."""
    return near_path(job.resolve(path), path)


def _ties_are_decided_once(job: JobFields) -> Iterator[Problem]:
    if job.timer_ties == "heap" and not (
        (job.policy is None or job.policy.order == "fifo")
        and job.executors is None
        and job.execution is None
    ):
        yield Problem(
            "heap is the order of RSLCPP's timers, which a policy, executors or execution "
            "times do not go with: leave it out",
            ("timer_ties",),
        )


def _paths_exist(job: JobFields) -> Iterator[Problem]:
    for index, folder in enumerate(job.search_path):
        path = job.resolve(folder)
        if not path.is_dir():
            what = "is not a folder" if path.exists() else "there is no such folder"
            near = _near(job, folder)
            yield Problem(f"{folder!r}: {what}{near}", ("search_path", index))
    for index, node in enumerate(job.nodes):
        for number, file in enumerate(node.parameter_files):
            path = job.resolve(file)
            if not path.is_file():
                what = "is not a file" if path.exists() else "there is no such parameter file"
                loc = ("nodes", index, "parameter_files", number)
                yield Problem(f"{file!r}: {what}{_near(job, file)}", loc)
    scripts = [
        (("nodes", index, node.kind), node.script or node.program or "")
        for index, node in enumerate(job.nodes)
        if node.script is not None or node.program is not None
    ]
    typed = [
        (("nodes", index, "stdin", number, "file"), item.file)
        for index, node in enumerate(job.nodes)
        for number, item in enumerate(node.stdin or ())
        if item.file is not None
    ]
    for place, file in [*scripts, *typed, *job.model_files()]:
        path = job.resolve(file)
        if not path.is_file():
            what = "is not a file" if path.exists() else "there is no such file"
            yield Problem(f"{file!r}: {what}{_near(job, file)}", place)
    for index, launch in enumerate(job.launch):
        path = job.resolve(launch.file)
        if not path.is_file():
            what = "is not a file" if path.exists() else "there is no such launch file"
            place = ("launch", index, "file")
            yield Problem(f"{launch.file!r}: {what}{_near(job, launch.file)}", place)
    for index, bag in enumerate(job.bags):
        if not job.resolve(bag.path).exists():
            message = f"{bag.path!r}: there is no such bag{_near(job, bag.path)}"
            yield Problem(message, ("bags", index, "path"))
