"""From a job to the processes of its native run."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

from rsltrace.adapters.processes.build import OBSERVER, PreloadLibrary, find_ros, library, program
from rsltrace.adapters.rclpy.entry import StartRule
from rsltrace.errors import SetupError
from rsltrace.job import Job, NodeSpec, locate
from rsltrace.native.processes.children import ProcessStart
from rsltrace.native.processes.wire import EntryOrder
from rsltrace.run.plans.entries import arguments_for_all, arguments_of, entry_keys, start_rule
from rsltrace.run.plans.processes import ProcessPrograms, as_python, ros_words

THE_BAGS = "the bags"
"""The name of the process that plays them."""


def starts_of(job: Job, like: EntryOrder, note: Callable[[str], None]) -> list[ProcessStart]:
    """Return what to start, in the order of the job, with orders like the given one; whoever plays
    its bags comes last. ``note`` is told what cannot be observed, and why.

    :raises JobError: a program, or the folder that it is to run in, is not there.
    """
    processes = ProcessPrograms(job, lambda text: None)
    observed = job.with_values(nodes=tuple(as_python(job, one) for one in job.nodes))
    like = replace(like, job=observed, module_path=tuple(sys.path))
    starts = []
    observer = cache(lambda: _observer(note))  # built for the first program
    for index, (spec, key) in enumerate(zip(job.nodes, entry_keys(job.nodes), strict=True)):
        where = spec.origin or locate(job, ("nodes", index, spec.kind))
        command = _command(observed, index, processes, where)
        variables = _observed_variables(spec, command, observer(), processes) if command else None
        starts.append(
            ProcessStart(
                spec.target,
                key,
                replace(like, index=index, command=command, environment=variables),
                _environment(spec, processes, is_program=bool(command)),
                processes.folder(spec, where),
                spec.node is None,
                None if spec.respawn is None else (spec.respawn.delay_ns, spec.respawn.times),
                spec.on_exception == "log" or spec.respawn is not None,
                spec.required,
                spec.component is not None,
            )
        )
    if job.bags:
        order = replace(like, plays_bags=True)
        starts.append(ProcessStart(THE_BAGS, THE_BAGS, order, dict(os.environ), None, True))
    return starts


def _observer(note: Callable[[str], None]) -> PreloadLibrary | None:
    """Return the library that observes programs, None if it cannot be built, with a note."""
    try:
        return library(note, sources=OBSERVER)
    except SetupError as error:
        note(f"programs are not observed: {error}")
        return None


def _observed_variables(
    spec: NodeSpec,
    command: Sequence[str],
    observer: PreloadLibrary | None,
    processes: ProcessPrograms,
) -> Mapping[str, str] | None:
    """Return the environment of a program with the observer in it, None without one."""
    if observer is None:
        return None
    return program(
        command,
        observer,
        surroundings=os.environ,
        environment=spec.environment,
        folder=None,
        search_path=processes.search_path,
        prefixes=processes.prefixes,
    ).environment


def _command(job: Job, index: int, processes: ProcessPrograms, where: str) -> tuple[str, ...]:
    """Return the command line of an entry that is not Python, empty for others."""
    spec = job.nodes[index]
    words = processes.command(spec, where)
    if words is None:
        return ()
    for_all = [] if spec.program and spec.origin else arguments_for_all(job)  # no node of a package
    arguments = arguments_of(job, index, for_all, where=where)
    return (*words, *spec.arguments, *ros_words(arguments))


def _environment(spec: NodeSpec, processes: ProcessPrograms, *, is_program: bool) -> dict[str, str]:
    """Return the variables of a process; a compiled one finds the libraries of ROS's wheels."""
    around = {**os.environ, "PYTHONUNBUFFERED": "1", **spec.environment}
    if not is_program:
        return around
    libraries = []
    try:
        libraries = [str(path) for path in find_ros().libraries if path.is_relative_to(sys.prefix)]
    except SetupError:
        pass  # what is sourced has said it itself
    for name, places in (
        ("LD_LIBRARY_PATH", libraries),
        ("PYTHONPATH", processes.search_path),
        ("AMENT_PREFIX_PATH", processes.prefixes),
    ):
        if places:
            given = [around[name]] if around.get(name) else []
            around[name] = os.pathsep.join([*given, *places])
    return around


def start_rules(job: Job) -> dict[str, StartRule]:
    """Return when those entries begin that do not begin with the run, by their keys."""
    keys = entry_keys(job.nodes)
    rules = {key: start_rule(job, index, keys) for index, key in enumerate(keys)}
    for key, spec in zip(keys, job.nodes, strict=True):
        if (rule := rules[key]) is not None and spec.component is not None:
            own = None if spec.start_after is None else spec.start_after.service
            rules[key] = replace(rule, service=own)  # it waits for its container itself
    return {key: rule for key, rule in rules.items() if rule not in (None, StartRule())}
