"""What a job needs on another machine: its text, its sources, its bags, each file with a hash."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import xxhash

from rsltrace.errors import ExploreError
from rsltrace.job import Job
from rsltrace.search.explore.trial import JobSource

SHIPPED_MAX = 256 << 20
"""Files of more bytes are not sent: they have to lie at the same place on every machine."""

_RECORDINGS = (".mcap", ".db3", ".bag", ".rrd")
"""Not sent for lying among the sources; those that the job plays are named by it."""
_BUILT = frozenset(("__pycache__", "node_modules", "build", "install", "log"))
_PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class Bundle:
    """The files of a job. ``root`` is the folder that all of them are below, on this machine;
    ``folder`` (the job's), the keys of ``files`` and ``large`` are seen from there.

    ``files`` has the contents of those that are sent, ``large`` the sizes of those that are not.
    """

    hash: str
    text: str
    name: str
    root: str
    folder: str
    files: Mapping[str, bytes]
    large: Mapping[str, int]

    def source(self, root: str | Path) -> JobSource:
        """Return the job, as it is where the bundle was unpacked."""
        folder = os.path.normpath(os.path.join(root, self.folder))
        return JobSource(os.path.join(folder, self.name), text=self.text, folder=folder)

    def unpack(self, root: Path) -> None:
        """Write the files below ``root``, and link to the large ones.

        :raises ExploreError: a large one is not on this machine.
        :raises OSError: the disk is full, say.
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
    from rsltrace.run.launch_files import without_launch_files

    job = without_launch_files(source.job()).job
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
    return Bundle(total.hexdigest(), text, name, root, folder, files, large)


def _sources(job: Job) -> Iterator[Path]:
    """Yield what lies in the folders of the nodes' modules, without what is built or recorded."""
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
