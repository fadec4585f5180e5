"""The whole of a job: everything that determines a run, checked before anything is constructed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rsltrace.errors import did_you_mean
from rsltrace.job.dump import job_resolved, job_yaml
from rsltrace.job.fields import JobFields
from rsltrace.job.parts.node import NodeSpec
from rsltrace.job.parts.part import after_fields
from rsltrace.job.parts.stop import StopSpec
from rsltrace.job.values.mappings import near_path
from rsltrace.job.values.problem import JobProblem, JobProblems, Loc
from rsltrace.job.values.times import format_time

# Entries that start after others: which entry is meant, and orders that cannot be.


def entry_meant(nodes: Sequence[NodeSpec], reference: str | int) -> int:
    """Return the place in ``nodes:`` of the entry with a name, a target or a number.

    :raises Problem: if there is none, or more than one.
    """
    if isinstance(reference, int):
        if reference < len(nodes):
            return reference
        raise JobProblem(f"there are {len(nodes)} entries, counted from 0: there is no {reference}")
    found = [index for index, spec in enumerate(nodes) if reference in _names(spec)]
    if len(found) == 1:
        return found[0]
    if found:
        places = ", ".join(map(str, found))
        raise JobProblem(
            f"several entries are called {reference!r}: give one of them a name, or write its "
            f"number in the list ({places})"
        )
    names = [name for spec in nodes for name in _names(spec)]
    hint = did_you_mean(reference, names, f"there are {', '.join(names)}")
    raise JobProblem(f"no entry of nodes is called {reference!r}: {hint}")


def _names(spec: NodeSpec) -> list[str]:
    """Return what an entry is called: its target, its name, its name in full."""
    if spec.name is None:
        return [spec.target]
    return [spec.target, spec.name, f"{(spec.namespace or '').rstrip('/')}/{spec.name}"]


def start_problems(job: JobFields) -> Iterator[JobProblem]:
    """Yield the starts that wait for what is not there, or never comes."""
    waits_for: dict[int, dict[str, int]] = {}
    for index, spec in enumerate(job.nodes):
        for key in ("started", "ended"):
            reference = None if spec.start_after is None else getattr(spec.start_after, key)
            if reference is None:
                continue
            place = ("nodes", index, "start_after", key)
            try:
                other = entry_meant(job.nodes, reference)
            except JobProblem as problem:
                if not job.launch:  # else it may be an entry of a launch file
                    yield JobProblem(problem.message, place)
                continue
            waits_for.setdefault(index, {})[key] = other
            if key == "ended" and job.nodes[other].node is not None:
                yield JobProblem(
                    f"{job.nodes[other].target} (nodes[{other}]) never ends: a 'node' lasts as "
                    "long as the run, only a main, executable, script or module ends",
                    place,
                )
    yield from _circles(waits_for)


def _circles(waits_for: dict[int, dict[str, int]]) -> Iterator[JobProblem]:
    told: set[int] = set()
    for first, after in waits_for.items():
        for key in after:
            path, at = [first], after[key]
            while at not in path and at in waits_for:
                path.append(at)
                at = next(iter(waits_for[at].values()))
            if at == first and not told & set(path):
                told.update(path)
                way = " → ".join(f"nodes[{index}]" for index in [*path, first])
                yield JobProblem(
                    f"it waits for itself, and never starts: {way}",
                    ("nodes", first, "start_after", key),
                )


# What must hold between the parts of a job: names, times, paths and options that go together.


def contradictions(job: JobFields) -> Iterator[JobProblem]:
    """Yield what is wrong with a job each of whose parts is right, with its place in the job."""
    yield from _something_to_run(job)
    yield from _times_in_order(job)
    yield from _distinct_names(job)
    yield from start_problems(job)
    yield from _bags_end(job)
    yield from _paths_exist(job)
    yield from _bags_progress(job)
    yield from _ties_are_decided_once(job)


def _bags_progress(job: JobFields) -> Iterator[JobProblem]:
    if job.progress is None:
        return
    if not job.bags:
        yield JobProblem(
            "there are no bags (bags:) whose progress could be published", ("progress",)
        )
    elif any(bag.loop is True for bag in job.bags):
        yield JobProblem("a bag that plays forever makes no progress", ("progress",))


def _bags_end(job: JobFields) -> Iterator[JobProblem]:
    if job.stop != StopSpec():
        return
    for index, bag in enumerate(job.bags):
        if bag.loop is True:
            yield JobProblem(
                "plays forever, and nothing ends the run: give a 'stop:', or a number of times",
                ("bags", index, "loop"),
            )


def _something_to_run(job: JobFields) -> Iterator[JobProblem]:
    if not job.nodes and not job.bags and not job.launch:
        place = ("nodes",) if "nodes" in job.given_fields else ()
        yield JobProblem(
            "a job needs at least one node (nodes:), launch file (launch:) or bag (bags:)",
            place,
        )


def _times_in_order(job: JobFields) -> Iterator[JobProblem]:
    start_ns, construct_ns, stop_ns = job.start_ns, job.construct_time_ns, job.stop.time_ns
    if start_ns is None:
        return
    if construct_ns is not None and construct_ns > start_ns:
        yield JobProblem(
            f"{format_time(construct_ns)} is after the start "
            f"({format_time(start_ns)}): nodes are constructed before the run starts",
            ("construct_time",),
        )
    if stop_ns is not None and stop_ns < start_ns:
        yield JobProblem(
            f"{format_time(stop_ns)} is before the start ({format_time(start_ns)}): it is a "
            "simulated time; 'duration' counts from the start",
            ("stop", "time"),
        )


def _distinct_names(job: JobFields) -> Iterator[JobProblem]:
    first: dict[tuple[str, str], int] = {}
    for index, node in enumerate(job.nodes):
        if node.name is None:
            continue
        key = (node.namespace or "/", node.name)
        if key in first:
            full_name = f"{key[0].rstrip('/')}/{node.name}"
            yield JobProblem(
                f"{full_name} is already the name of nodes[{first[key]}]: give one of them "
                "another name or namespace",
                ("nodes", index, "name"),
            )
        first.setdefault(key, index)


def _ties_are_decided_once(job: JobFields) -> Iterator[JobProblem]:
    if job.timer_ties == "heap" and not (
        (job.policy is None or job.policy.order == "fifo")
        and job.executors is None
        and job.execution is None
    ):
        yield JobProblem(
            "heap is the order of RSLCPP's timers, which a policy, executors or execution "
            "times do not go with: leave it out",
            ("timer_ties",),
        )


def _paths(job: JobFields) -> Iterator[tuple[Loc, str, str]]:
    """Yield the place of each path in a job, the path, and what has to be there."""
    for index, folder in enumerate(job.search_path):
        yield ("search_path", index), folder, "folder"
    for index, node in enumerate(job.nodes):
        for number, file in enumerate(node.parameter_files):
            yield ("nodes", index, "parameter_files", number), file, "parameter file"
    for index, node in enumerate(job.nodes):
        if (program := node.script or node.program) is not None:
            yield ("nodes", index, node.kind), program, "file"
    for index, node in enumerate(job.nodes):
        for number, item in enumerate(node.stdin or ()):
            if item.file is not None:
                yield ("nodes", index, "stdin", number, "file"), item.file, "file"
    for place, file in job.model_files():
        yield place, file, "file"
    for index, launch in enumerate(job.launch):
        yield ("launch", index, "file"), launch.file, "launch file"
    for index, bag in enumerate(job.bags):
        yield ("bags", index, "path"), bag.path, "bag"


def _paths_exist(job: JobFields) -> Iterator[JobProblem]:
    for place, path, what in _paths(job):
        full = job.resolve(path)
        is_there = {"folder": Path.is_dir, "bag": Path.exists}.get(what, Path.is_file)
        if not is_there(full):
            other = f"is not a {'folder' if what == 'folder' else 'file'}"
            said = other if full.exists() else f"there is no such {what}"
            yield JobProblem(f"{path!r}: {said}{near_path(full, path)}", place)


class Job(JobFields):
    """A job, from ``load_job`` or built in Python. Frozen; raises ``JobError`` when wrong.

    Times are integer nanoseconds of simulated time; ``start_ns`` and ``construct_time_ns`` are
    ``None`` where the run decides (first bag message or 0; the start). Paths in it are relative to
    ``base_dir`` (an absolute path; the current folder when built in Python): see ``resolve``.
    """

    @property
    def source_text(self) -> str:
        """The YAML text the job was read from; of one built in Python, or put together from
        several files or with overrides, ``to_yaml()``."""
        if self.composed is not None:
            return f"{self.composed.header()}{self.to_yaml()}"
        return self.to_yaml() if self.given_text is None else self.given_text

    def shown(self, path: str) -> str:
        """Return a path of the job as messages show it: beside the job file as it was named."""
        return os.path.normpath(os.path.join(os.path.dirname(self.source_name), path))

    def to_yaml(self) -> str:
        """Return a job file that loads as this job (from ``base_dir``).

        Classes and functions appear as ``module:qualname``, other Python objects among
        ``arguments`` by the name of their class; a job with local ones does not load again.
        """
        return job_yaml(self)

    def resolved(self) -> dict[str, Any]:
        """Return the job as JSON-compatible values with every default filled in.

        Times are in nanoseconds under the fields' names, paths relative to ``base_dir``, so that
        the result is the same on every machine.
        """
        return job_resolved(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows of it."""
        from rsltrace.trace.model.html import HtmlSheet

        sheet = HtmlSheet(f"job {self.source_name}")
        sheet.table(
            ("", "runs", "named", "parameters"),
            ((n.kind, n.target, n.name or "", ", ".join(n.parameters)) for n in self.nodes),
        )
        sheet.table(("launch file",), ((one.file,) for one in self.launch))
        sheet.table(("bag",), ((bag.path,) for bag in self.bags))
        sheet.text(self.to_yaml(), summary="as YAML")
        return sheet.html()

    @after_fields
    def _check_whole(self) -> None:
        problems = list(contradictions(self))
        if problems:
            raise JobProblems(problems)
