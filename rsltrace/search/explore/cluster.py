"""Trials on the workers of a Dask cluster.

Each Dask worker gets the files of the job once, under their hash, and runs trials in processes
(``workers.Worker``), as many at a time as it has threads. Only rows, and the traces that are kept,
come back.
"""

from __future__ import annotations

import os
import queue
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import xxhash

from rsltrace._version import __version__
from rsltrace.errors import ExploreError
from rsltrace.job import Job
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.trial import (
    CRASH,
    Failure,
    JobSource,
    KeptTraces,
    Trial,
    TrialResult,
    result_of,
)
from rsltrace.search.explore.workers import Worker

SHIPPED_MAX = 256 << 20
"""Larger files are not sent: they must be at the same path on every machine."""

_RECORDINGS = (".mcap", ".db3", ".bag", ".rrd")
"""Not sent with the sources; those that the job plays are sent because it names them."""
_BUILT = frozenset(("__pycache__", "node_modules", "build", "install", "log"))
_PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class Bundle:
    """The files of a job. ``root`` is their common folder on this machine; ``folder`` (the job's)
    and the keys of ``files`` and ``large`` are relative to it.

    ``files`` has the contents of those that are sent, ``large`` the sizes of those that are not.
    """

    hash: str
    text: str
    name: str
    root: str
    folder: str
    files: Mapping[str, bytes]
    large: Mapping[str, int]
    begins_recorded: bool = False

    def source(self, root: str | Path) -> JobSource:
        """Return the job in the folder where the bundle was unpacked."""
        folder = os.path.normpath(os.path.join(root, self.folder))
        return JobSource(
            os.path.join(folder, self.name),
            text=self.text,
            folder=folder,
            begins_recorded=self.begins_recorded,
        )

    def unpack(self, root: Path) -> None:
        """Write the files below ``root``, and link to the large ones.

        :raises ExploreError, OSError: a large one is not on this machine, or a file cannot be
            written.
        """
        for name, data in self.files.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        (root / self.folder).mkdir(parents=True, exist_ok=True)
        for name, size in self.large.items():
            there = Path(self.root, name)
            if not there.is_file() or there.stat().st_size != size:
                raise ExploreError(
                    f"{there} ({size >> 20} MiB) is not on this machine, or another one: files of "
                    f"more than {SHIPPED_MAX >> 20} MiB are not sent to workers; put it at the "
                    "same path on each, a shared disk, say"
                )
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(there)


def bundle_of(source: JobSource) -> Bundle:
    """Read all that a job needs.

    :raises JobError: the job is wrong.
    :raises ExploreError: a file cannot be read.
    """
    from rsltrace.run.inputs import expand_launch_files

    job = expand_launch_files(source.job()).job
    base = Path(job.base_dir)
    paths = sorted(set(_sources(job)) | set(_named(job)))
    root = os.path.commonpath([base, *(path.parent for path in paths)])
    files: dict[str, bytes] = {}
    large: dict[str, int] = {}
    text, folder = job.to_yaml(), os.path.relpath(base, root)
    total = xxhash.xxh3_128(f"{text}\0{folder}\0".encode())
    for path in paths:
        name = os.path.relpath(path, root)
        try:
            size = path.stat().st_size
            if size > SHIPPED_MAX:
                large[name] = size
            else:
                files[name] = path.read_bytes()
            total.update(f"{name}\0{size}\0{_hash(path)}\0".encode())
        except OSError as error:
            raise ExploreError(f"{path} cannot be sent to workers: {error.strerror}") from None
    name = Path(job.source_name).name or "job.yaml"
    begins_recorded = source.begins_recorded
    return Bundle(total.hexdigest(), text, name, root, folder, files, large, begins_recorded)


def _sources(job: Job) -> Iterator[Path]:
    """Yield the files of the modules' folders, except built and recorded ones."""
    for folder in job.search_path:
        for place, folders, names in os.walk(job.resolve(folder)):
            folders[:] = [one for one in folders if not one.startswith(".") and one not in _BUILT]
            for name in names:
                path = Path(place, name)
                if not name.startswith(".") and path.suffix not in _RECORDINGS and path.is_file():
                    yield path


def _named(job: Job) -> Iterator[Path]:
    """Yield the files that a job names."""
    named = [bag.path for bag in job.bags]
    named += [file for _, file in job.model_files()]
    for node in job.nodes:
        named += [*node.parameter_files]
        named += [file for file in (node.script, node.program) if file is not None]
        named += [typed.file for typed in node.stdin or () if typed.file is not None]
    for name in named:
        path = job.resolve(name)
        if path.is_dir():
            yield from (file for file in path.rglob("*") if file.is_file())
        else:
            yield path


def _hash(path: Path) -> str:
    total = xxhash.xxh3_128()
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            total.update(piece)
    return total.hexdigest()


try:
    from distributed import Client, Future, KilledWorker, WorkerPlugin, get_worker
    from distributed.comm.core import CommClosedError
except ImportError:
    raise ExploreError(
        "a cluster needs Dask: pip install 'rsltrace[explore]', here and on the workers"
    ) from None

CONFIGURED = "dask"
"""Stands for the scheduler that Dask's own configuration names (DASK_SCHEDULER_ADDRESS)."""

_CONNECT_S = 30
_TRIES_MAX = 3
_AHEAD = 2
"""Tasks queued per worker thread, so that it does not wait for us."""


class _WorkerJob(WorkerPlugin):  # type: ignore[misc]
    """A job on a Dask worker: its files, and processes that run its trials."""

    idempotent = True

    def __init__(self, bundle: Bundle, *, pins: bool) -> None:
        self.bundle = bundle
        self.name = f"rsltrace-{bundle.hash}-{pins}"
        self._pins = pins

    def setup(self, worker: Any) -> None:
        """Unpack the files."""
        self.folder = Path(worker.local_directory) / f"{self.name}-{os.getpid()}"
        shutil.rmtree(self.folder, ignore_errors=True)
        self.bundle.unpack(self.folder)
        self.traces = self.folder.with_name(f"{self.folder.name}.traces")
        self.traces.mkdir(exist_ok=True)
        self._source = self.bundle.source(self.folder)
        self._idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()

    def teardown(self, worker: Any) -> None:
        """End the processes, and delete the files."""
        with suppress(queue.Empty):
            while True:
                self._idle.get_nowait().close()
        for folder in (self.folder, self.traces):
            shutil.rmtree(folder, ignore_errors=True)

    def run(
        self, trial: Trial, wants: TrialOptions, timeout_s: float | None, name: str
    ) -> TrialResult:
        """Run a trial in a process that is idle, or a new one."""
        try:
            one = self._idle.get_nowait()
        except queue.Empty:
            one = Worker(self._source, pins=self._pins)
        try:
            found = one.run(trial, self.traces / name, wants, timeout_s)
        except BaseException:
            one.close()
            raise
        self._idle.put(one)
        return found


def _run(
    place: str, trial: Mapping[str, Any], wants: Mapping[str, Any], timeout_s: float | None
) -> tuple[dict[str, Any], str]:
    """Run a trial (the Dask task); return the result's values and the worker's address."""
    worker = get_worker()
    job: _WorkerJob = worker.plugins[place]
    name = f"{trial['number']:06d}.mcap"
    found = job.run(Trial(**trial), TrialOptions(**wants), timeout_s, name)
    return found.as_values(), str(worker.address)


def _take_trace(path: str, read: bool) -> bytes:
    """Move a trace off the worker, or only delete it."""
    data = Path(path).read_bytes() if read else b""
    Path(path).unlink(missing_ok=True)
    return data


def _version() -> str:
    return __version__


class Cluster:
    """The workers of a cluster, used like ``workers.Workers``: ``submit`` while ``idle``;
    ``results`` waits for the next ones. A context manager."""

    def __init__(self, source: JobSource, address: str, *, pins: bool = True) -> None:
        """``address``: of a scheduler (``tcp://host:8786``), the path of a scheduler file, or
        ``dask`` for what Dask's configuration says.

        :raises JobError: the job is wrong.
        :raises ExploreError: a file of it cannot be read.
        """
        self._job = _WorkerJob(bundle_of(source), pins=pins)
        self._address = address
        self._futures: dict[Future, tuple[Trial, Path]] = {}
        self._kept = KeptTraces()
        self._client: Client | None = None

    def __enter__(self) -> Cluster:
        """Connect, and send the job's files to the workers there are.

        :raises ExploreError: the scheduler does not answer, or a worker cannot run the job.
        """
        try:
            self._client = _connected(self._address)
            self._client.wait_for_workers(1, timeout=_CONNECT_S)
            self._check_versions()
            self._client.register_plugin(self._job)
        except ExploreError:
            self.__exit__()
            raise
        except Exception as error:
            self.__exit__()
            said = str(error) or type(error).__name__
            raise ExploreError(f"the cluster {self._address} cannot be used: {said}") from None
        return self

    def __exit__(self, *_: object) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        with suppress(Exception):
            client.cancel(list(self._futures), force=True)
        with suppress(Exception):
            client.unregister_worker_plugin(self._job.name)
        client.close()

    def _check_versions(self) -> None:
        """Check that the workers have this version of rsltrace."""
        assert self._client is not None
        answers = self._client.run(_version, on_error="return")
        for address, answer in answers.items():
            if isinstance(answer, BaseException):
                raise ExploreError(
                    f"the worker {address} cannot run rsltrace ({type(answer).__name__}: {answer}):"
                    f" pip install 'rsltrace[ros,explore]=={__version__}' there"
                )
            if answer != __version__:
                raise ExploreError(
                    f"the worker {address} has rsltrace {answer}, this machine {__version__}: "
                    "install one version on all"
                )

    @property
    def threads(self) -> int:
        """How many trials the cluster runs at a time, now."""
        assert self._client is not None
        return sum(self._client.nthreads().values())

    @property
    def idle(self) -> int:
        """How many more trials can be begun."""
        return max(_AHEAD * self.threads - self.busy, 0)

    @property
    def busy(self) -> int:
        """How many trials are under way."""
        return len(self._futures)

    def submit(
        self, trial: Trial, trace: Path, wants: TrialOptions, timeout_s: float | None = None
    ) -> None:
        """Have a worker run a trial. A worker that dies is replaced."""
        assert self._client is not None
        words = (self._job.name, asdict(trial), asdict(wants), timeout_s)
        future = self._client.submit(_run, *words, pure=False, retries=_TRIES_MAX - 1)
        self._futures[future] = (trial, trace)

    def results(self, wait_s: float | None = None) -> Iterator[TrialResult]:
        """Wait for results, ``wait_s`` at most, and yield them.

        :raises ExploreError: a run could not start, or the cluster has disconnected.
        """
        ready = self._ready(wait_s)
        for future in ready:
            trial, trace = self._futures.pop(future)
            yield self._result(future, trial, trace)

    def _ready(self, wait_s: float | None) -> list[Future]:
        if not self._futures:
            return []
        end_s = None if wait_s is None else time.monotonic() + wait_s
        while True:
            assert self._client is not None
            if self._client.status not in ("running", "connecting"):
                raise ExploreError(f"the cluster {self._address} has disconnected")
            found = [one for one in self._futures if one.done()]
            if found or (end_s is not None and time.monotonic() >= end_s):
                return found
            time.sleep(0.02)

    def _result(self, future: Future, trial: Trial, trace: Path) -> TrialResult:
        try:
            values, address = future.result()
        except KilledWorker:
            text = "the workers that ran it have died, one after the other"
            return TrialResult(trial, failure=Failure(CRASH, text, "crash of the worker"))
        except ExploreError:
            raise
        except Exception as error:
            raise ExploreError(
                f"trial {trial.number} could not be run on {self._address}: "
                f"{type(error).__name__}: {error}"
            ) from None
        finally:
            future.release()
        return self._with_trace(result_of(values), address, trace)

    def _with_trace(self, found: TrialResult, address: str, trace: Path) -> TrialResult:
        """Fetch the trace of a run if it may be kept, else have it deleted."""
        number, failure = found.trial.number, found.failure
        wanted = failure is None or self._kept.add(failure.key, number) != number
        if found.trace is None:
            return found
        assert self._client is not None
        try:
            answer = self._client.run(_take_trace, found.trace, wanted, workers=[address])
        except (OSError, CommClosedError, ValueError):  # the worker has gone
            return replace(found, trace=None)
        if not wanted:
            return replace(found, trace=None)
        trace.write_bytes(answer[address])
        return replace(found, trace=str(trace))


def _connected(address: str) -> Client:
    if address == CONFIGURED:
        from dask import config

        if not config.get("scheduler-address", None):
            raise ExploreError(
                "Dask's configuration names no scheduler: set DASK_SCHEDULER_ADDRESS, or give its "
                "address"
            )
        return Client(timeout=_CONNECT_S)
    if address.endswith(".json"):
        if not Path(address).is_file():
            raise ExploreError(f"there is no scheduler file {address}")
        return Client(scheduler_file=address, timeout=_CONNECT_S)
    return Client(address, timeout=_CONNECT_S)
