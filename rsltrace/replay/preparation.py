"""What a replay is going to run, known before it starts."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch import ros_launch
from rsltrace.errors import JobError, ReplayError, TraceError
from rsltrace.job import Job, StopSpec, job_from_text, load_job
from rsltrace.job.fields import COMMAND_LINE
from rsltrace.job.parts.scheduling import PolicySpec
from rsltrace.job.reading.load import job_from_resolved
from rsltrace.job.reading.substitute import installed_prefixes
from rsltrace.replay.code import JobCodeFile, job_code_files, module_file
from rsltrace.replay.edits import Edit, parse_edit
from rsltrace.run.inputs import expand_launch_files
from rsltrace.run.plans.recorded_order import last_ns
from rsltrace.run.process import RunCallbacks, python_path
from rsltrace.run.provenance import environment
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.finding import GuardMode
from rsltrace.trace.native import is_native
from rsltrace.trace.reader import Trace

# The folder of a trace's job. A trace holds no absolute paths, so the folder is looked for.

_NAME_MAX = 255
"""Bytes that the name of a file can have."""


def without_bags(load: Callable[[tuple[str, ...]], Job]) -> Job:
    """Return a job without its bags, which need not exist. ``load`` gets overrides.

    :raises JobError: it cannot be used.
    """
    try:
        return load(("bags=[]",))
    except JobError as error:
        try:
            return load(("bags=[]", "progress=null"))  # who has no bags has no progress
        except JobError:
            raise error from None


def is_job(path: Path) -> bool:
    return path.suffix in (".yaml", ".yml", ".json")


def load_without_bags(path: Path) -> Job:
    """Load a job file without its bags.

    :raises JobError: it cannot be used.
    """
    return without_bags(lambda to: load_job(path, overrides=to))


def job_in_trace(trace: Trace, folder: Path, *, bags: bool = True) -> Job:
    """Return the job in a trace, resolved in ``folder``. Nothing is run.

    Without ``bags``, the job has none and they need not exist.

    :raises ReplayError: the trace holds no job, or one of another version.
    """
    try:
        resolved = _resolved(trace)
        _follow_trace_order(trace, resolved, folder)
        if not bags:
            resolved.update(bags=[], progress=None)
        return job_from_resolved(
            resolved, name=job_name(trace), text=trace.job_text, folder=folder.absolute()
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ReplayError(f"the job in {trace.name} cannot be read: {error}") from error
    except JobError as error:
        raise ReplayError(
            f"the job in {trace.name} cannot be run in {folder}: {error}; the folder of the job "
            "file is named with --job-folder DIR"
        ) from error


def _resolved(trace: Trace) -> dict[str, Any]:
    try:
        resolved = json.loads(trace.job.get("resolved") or "null")
    except (ValueError, RecursionError) as error:
        raise ReplayError(f"the job in {trace.name} cannot be read: {error}") from error
    if not isinstance(resolved, dict):
        raise ReplayError(f"{trace.name} does not hold the job that was run: nothing to replay")
    return resolved


def _follow_trace_order(trace: Trace, resolved: dict[str, Any], folder: Path) -> None:
    """Let a job that followed a missing recording follow the trace, which has its order."""
    policy = resolved.get("policy")
    if not isinstance(policy, dict) or not isinstance(policy.get("recorded"), str):
        return
    if not (folder / policy["recorded"]).is_file():
        resolved["policy"] = {"recorded": str(Path(trace.name).resolve())}


def job_name(trace: Trace) -> str:
    """Return the file name of a trace's job, or "" if it had no file."""
    name = Path(trace.job.get("name", "")).name
    return "" if name[:1] == "<" or len(name.encode("utf-8", "replace")) > _NAME_MAX else name


def job_folder_of(trace: Trace, given: Path | None) -> Path:
    """Return the folder of a trace's job: the given one, or one where the job is found.

    :raises ReplayError: with what was looked for, and where.
    """
    if given is not None:
        if not given.is_dir():
            raise ReplayError(f"--job-folder {given}: there is no such folder")
        return given
    if trace.job.get("name") == COMMAND_LINE:
        return Path()
    beside = [] if "://" in trace.name else [Path(trace.name).parent]
    places = list(dict.fromkeys([*beside, Path()]))
    wanted = _folder_markers(trace)
    best = max(places, key=lambda place: _match_folder(trace, place, wanted))
    if _match_folder(trace, best, wanted)[0] or not wanted:
        return best
    listed = ", ".join(wanted[:5]) + (f" and {len(wanted) - 5} more" if len(wanted) > 5 else "")
    where = " and in ".join(_shown(place) for place in places)
    raise ReplayError(
        f"the job of {trace.name} is not here: looked for {listed} in {where}; name the folder "
        "that the job file is in with --job-folder DIR"
    )


def _shown(place: Path) -> str:
    return "the working directory" if place == Path() else str(place)


def _folder_markers(trace: Trace) -> list[str]:
    """Return the files that identify the job's folder: its file, or its nodes' modules."""
    if job_name(trace):
        return [job_name(trace)]
    names = [name for name in trace.metadata(METADATA_SOURCES) if not name.startswith("file:")]
    return [name for name in names if not _is_of_workspace(name)]


def _is_of_workspace(module: str) -> bool:
    """Whether a module is found in a sourced workspace, or by ``PYTHONPATH``, wherever the job's
    folder is."""
    prefixes = [*installed_prefixes(), *python_path()]
    file = module_file(module, []) if prefixes else None
    return file is not None and any(map(file.is_relative_to, prefixes))


def _match_folder(trace: Trace, folder: Path, wanted: Sequence[str]) -> tuple[bool, bool]:
    """Return whether a folder has the files, and whether the job file is unchanged."""
    if not job_name(trace):
        folders = _search(trace, folder)
        return all(module_file(name, folders, installed=False) for name in wanted), False
    file = folder / job_name(trace)
    return file.is_file(), file.is_file() and _text(file) == trace.job_text


def _search(trace: Trace, folder: Path) -> list[str]:
    listed = _resolved(trace).get("search_path")
    return [str(folder / str(path)) for path in (listed if isinstance(listed, list) else ["."])]


def _text(file: Path) -> str:
    try:
        return file.read_bytes().decode("utf-8-sig", "replace")
    except OSError:
        return ""


# A trace looks like data and may come from anyone, but its job may name any code. So it is replayed
# without ``trust`` only if ``record`` of the job file in the working directory would run the same:
# the same nodes (or some of them) with the same parameters, arguments, launch files, hooks and
# bags. Settings of time and order may differ.

_LAUNCH = (".launch.xml", ".launch.yaml", ".launch.yml")
_MAY_DIFFER = frozenset(
    (
        "start_ns",
        "construct_time_ns",
        "stop",
        "seed",
        "timer_ties",
        "livelock_limit",
        "policy",
        "parallel",
        "min_time_step_ns",
        "executors",
        "execution",
        "record",
    )
)
"""Keys of a job that say when, in which order and for how long its nodes run, and what is kept."""


def why_not_trusted(trace: Trace, job: Job, folder: Path, *, named: bool, bags: bool = True) -> str:
    """Return why replaying a trace needs ``trust``, or "". Nothing is run to find out.

    ``named``: the user has named the job's folder. ``bags``: the job's bags will play.
    """
    name = job_name(trace)
    if not named and folder.resolve() != Path.cwd():
        return f"its job is in {folder}, which is not the working directory"
    if not name:
        made = "of a command line" if trace.job.get("name") == COMMAND_LINE else "made in Python"
        return f"its job was {made}, so there is no job file here that says the same"
    try:
        own = _own_job(folder / name, bags=bags)
    except (JobError, OSError, RecursionError):
        own = None
    if own is not None:
        own = _following_native(own, job)
    if own is None:
        if (folder / name).exists():  # a launch file in Python
            return f"its job is {name}, which cannot be compared with it without running code"
        return f"there is no {name} in {folder} to compare its job with"
    differing = _differing(own, job)
    if differing:
        return f"its job differs from {folder / name} in {', '.join(differing)}"
    if trace.edits:
        return "it holds edits, which the nodes would run with"
    if any(found.mode is GuardMode.RECORD for one in trace.findings.values() for found in one):
        return "it holds recorded answers (of files, sockets, …) that the nodes would get"
    return ""


def _following_native(own: Job, job: Job) -> Job:
    """Return a job as it would follow the native run that another one follows, if it does."""
    recorded = None if job.policy is None else job.policy.recorded
    if recorded is None or own.policy == job.policy:
        return own
    with suppress(TraceError), Trace.open(job.resolve(recorded)) as trace:
        if is_native(trace):
            return job_of_native(trace, own)
    return own


def _own_job(file: Path, *, bags: bool) -> Job | None:
    """Return the job of a job or launch file, None if that needs running a program."""
    if file.name.endswith(_LAUNCH):
        spec = json.dumps({"file": file.name, "arguments": {}})
        job = job_from_text("{}", str(file), file.parent, overrides=[f"launch.+={spec}"])
    elif file.suffix in (".yaml", ".yml", ".json"):
        job = load_job(file) if bags else load_without_bags(file)
    else:
        return None
    for launch in job.launch:
        # ROS's own launch runs what a launch file tells it to.
        if not launch.file.endswith(_LAUNCH) or ros_launch.can_read(job.resolve(launch.file)):
            return None
    return expand_launch_files(job, programs=False).job


def _differing(own: Job, job: Job) -> list[str]:
    a, b = _values(own), _values(job)
    fewer = all(node in a["nodes"] for node in b["nodes"])  # of the nodes that are named here
    return [key for key in a if a[key] != b[key] and not (key == "nodes" and fewer)]


def _values(job: Job) -> dict[str, Any]:
    resolved = json.loads(json.dumps(job.resolved()))
    values = {key: value for key, value in resolved.items() if key not in _MAY_DIFFER}
    values["guard"] = {key: value for key, value in values["guard"].items() if key != "pin"}
    policy = resolved["policy"] or {}
    values["stop.function"] = resolved["stop"]["function"]
    values["policy"] = policy.get("function"), policy.get("recorded")
    values["files"] = sorted(job.model_files())
    return values


Position = int | str
"""An event by its index (an int, or digits), or a simulated time (``2.5``, ``60s``, ``5ms``)."""


@dataclass(frozen=True, slots=True)
class EnvironmentChange:
    """A version or setting of the process that differs from the recording."""

    name: str
    recorded: str
    present: str


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """A replay that is ready to start. ``distrust`` says why it needs ``trust``, or is "".

    ``code`` is what would run, ``changes`` are differences of the environment. ``trace`` is open.
    """

    trace: Trace
    job: Job
    folder: Path
    code: tuple[JobCodeFile, ...]
    changes: tuple[EnvironmentChange, ...]
    distrust: str
    notes: tuple[str, ...]
    edits: tuple[Edit, ...] = ()
    """The edits of the run, if the trace is a branch."""


@contextmanager
def prepare_replay(
    path: str | Path,
    job_folder: Path | None = None,
    job: Job | None = None,
    *,
    bags: bool = True,
) -> Iterator[ReplayPlan]:
    """Open a trace and find out what replaying it needs. Runs and imports nothing.

    Without ``bags``, those of the job need not exist. A given ``job`` replaces the trace's own, and
    is trusted.

    :raises TraceError, ReplayError: the trace is damaged, or something it needs is missing.
    """
    if "://" in str(path):
        raise ReplayError(f"{path}: download a trace to replay it")
    with Trace.open(path) as trace:
        if trace.event_count == 0:
            raise ReplayError(f"{path} has no events to replay")
        if job is None:
            folder = job_folder_of(trace, job_folder)
            job = job_in_trace(trace, folder, bags=bags)
            named = job_folder is not None
            distrust = why_not_trusted(trace, job, folder, named=named, bags=bags)
        else:
            folder, distrust = job.base_dir, ""
        if is_native(trace):
            job = job_of_native(trace, job)
        yield ReplayPlan(
            trace,
            job,
            folder,
            job_code_files(job, trace.metadata(METADATA_SOURCES)),
            tuple(_changes(trace)),
            distrust,
            tuple(_notes(trace)),
            tuple(map(parse_edit, trace.edits)),
        )


_OF_SIMULATIONS = (
    *("delay", "execution", "executors", "min_time_step_ns", "construct_time_ns", "clocks"),
    *("faults", "threads", "vary", "timer_ties", "bags", "progress"),
)
"""Parts of a job without effect in a native run, and what a replay of one has from its trace."""


_ONLY_OF_PROCESSES = (
    *("environment", "working_directory", "respawn", "instant_sleep", "intra_process"),
)


def job_of_native(trace: Trace, job: Job) -> Job:
    """Return the job that does again what a native run did. Python runs in rsltrace's own process,
    as that run has observed it, except for what only a process of its own can have."""
    from rsltrace.run.plans.processes import as_python  # which loads much

    nodes = (
        spec if any(getattr(spec, key) for key in _ONLY_OF_PROCESSES) else as_python(job, spec)
        for spec in job.nodes
    )
    defaults = {key: Job.fields[key].get_default() for key in _OF_SIMULATIONS}
    lasted_ns = last_ns(trace) - trace.start_ns
    return job.with_values(
        **defaults,
        nodes=tuple(nodes),
        start_ns=trace.start_ns,
        policy=PolicySpec(recorded=os.path.relpath(trace.name, job.base_dir)),
        stop=StopSpec(duration_ns=lasted_ns),
    )


def _changes(trace: Trace) -> Iterator[EnvironmentChange]:
    """Yield the differences of environment, as far as known before libraries are loaded."""
    present = environment()
    recorded = {"math": present["math"], **trace.environment}  # older traces do not tell it
    for name in sorted({*recorded, *present} - {"numerics", "ros_distro", "addresses"}):
        if recorded.get(name) != present.get(name):
            yield EnvironmentChange(name, recorded.get(name, ""), present.get(name, ""))


def _notes(trace: Trace) -> Iterator[str]:
    if not trace.complete:
        yield (
            f"the trace was cut off: it is replayed as far as it goes, {trace.event_count} events"
        )


@dataclass(frozen=True, slots=True)
class ReplayOutput:
    """Where a replay's own trace goes (``path``; None: it is not kept), and who watches the run.

    ``force`` replaces a trace that is there; ``echo`` prints the nodes' log records.
    """

    path: Path | None = None
    force: bool = False
    echo: bool = False
    observer: RunCallbacks | None = None

    @contextmanager
    def place(self) -> Iterator[Path]:
        """Yield the path of the trace, else that of a temporary file."""
        if self.path is not None:
            yield self.path
            return
        with tempfile.TemporaryDirectory(prefix="rsltrace-replay-") as folder:
            yield Path(folder, "replay.mcap")

    def kept(self, place: Path) -> Path | None:
        """Return where the trace is after the run, None if it is not kept."""
        return None if self.path is None else place


NOT_KEPT = ReplayOutput()


def event_count_to(trace: Trace, position: Position, option: str) -> int:
    """Return the number of events up to and including a position, which ``option`` gives.

    :raises ReplayError: it is not a position, or before the first event.
    """
    from rsltrace.job.values.times import parse_time_in_run

    text = str(position).strip()
    if text.isascii() and text.isdigit():
        return int(text) + 1
    try:
        time_ns = parse_time_in_run(text).stamp_ns(trace.start_ns, trace.end_ns)
    except ValueError as error:
        raise ReplayError(
            f"{option}: {text!r} is neither the index of an event (812) nor a time (60s, 2.5): "
            f"{error}"
        ) from None
    count = 0
    for rows in trace.events():
        late = (rows["stamp"] > time_ns) & (rows["kind"] != EventKind.CONSTRUCT)
        if late.any():
            return count + int(late.argmax())
        count += len(rows)
    return count
