"""Auditing a path or a job: from files to findings."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

from rsltrace.adapters.workspace.installs import module_folders
from rsltrace.errors import JobError
from rsltrace.guard.audit.calls import Place, find_calls
from rsltrace.guard.audit.files import Collection, SourceFile, collect_modules, collect_path
from rsltrace.guard.audit.model import Audit, Found
from rsltrace.guard.audit.names import Names
from rsltrace.guard.audit.treatment import GuardTreatment, module_of
from rsltrace.job import Job, locate
from rsltrace.trace.model.finding import Policy

Executables = Callable[[str, str], "str | Path"]
"""Given ``package/executable`` and where it is written: ``module:function``, or a script's path."""


def audit_path(path: Path) -> Audit:
    """Look at a Python file, or at all below a folder; the guard's defaults are taken.

    :raises JobError: if there is nothing to look at.
    """
    if not path.exists():
        raise JobError(f"{path}: there is no such file or folder")
    found = collect_path(path)
    if not found.files and not found.troubles:
        raise JobError(f"{path}: there is no Python file in this folder")
    return _audit(found, GuardTreatment(Policy()))


def audit_job(job: Job, executable: Executables) -> Audit:
    """Look at the modules of a job's nodes, and at what those import below its search path.

    :raises JobError: if a node's module is not found.
    """
    names: dict[str, str] = {}
    programs: set[str] = set()
    scripts = []
    targets: list[str | Path] = []
    for index, spec in enumerate(job.nodes):
        where = locate(job, ("nodes", index, spec.kind))
        if spec.program is not None or spec.component is not None:
            targets.append("")  # whatever it does is no Python's doing
            continue
        target: str | Path = spec.target
        if spec.executable is not None:
            target = executable(spec.executable, where)
        elif spec.script is not None:
            target = job.resolve(spec.script)
        elif spec.module is not None:
            inside = f"{spec.module}.__main__"  # if it is a package
            programs |= {spec.module, inside}
            names.setdefault(inside, where)
        targets.append(target)
        if isinstance(target, Path):
            scripts.append(target)
        else:
            names.setdefault(module_of(target), where)
    folders = [job.resolve(folder).resolve() for folder in job.search_path]
    if any(spec.executable is not None for spec in job.nodes):
        folders += [folder for folder in module_folders(folders) if folder not in folders]
    collection, missing = collect_modules(list(names), scripts, folders, programs)
    for name in missing:
        parent = name.rpartition(".")[0]
        if parent and parent in collection.files:
            continue
        raise JobError(
            f"there is no module {name!r}: search_path has {', '.join(map(str, job.search_path))}",
            where=names[name],
        )
    return _audit(collection, GuardTreatment.of_job(job, targets, folders))


def _audit(collection: Collection, guard: GuardTreatment) -> Audit:
    sources = list(collection.files.values())
    names = Names({source.module.name: source.module for source in sources})
    called: set[ast.AST] = set()
    places: list[tuple[SourceFile, Place]] = []
    for source in sources:
        for place in find_calls(source.module, names, as_script=source.as_script):
            if place.alias is None:
                called |= names.passed
            places.append((source, place))
    found = set()
    silenced = 0
    for source, place in places:
        if place.alias is not None and place.alias in called:
            continue  # where it is called is found, too
        if _is_silenced(source, place):
            silenced += 1
            continue
        found.add(_found(source, place, guard))
    return Audit(
        tuple(sorted(found)),
        len(sources),
        tuple(collection.troubles),
        tuple(collection.notes),
        silenced,
    )


def _is_silenced(source: SourceFile, place: Place) -> bool:
    first = place.node.lineno
    last = first if isinstance(place.node, ast.stmt) else place.node.end_lineno or first
    for line in range(first, last + 1):
        kinds = source.allowed.get(line)
        if kinds is not None and (not kinds or place.rule.kind in kinds):
            return True
    return False


def _found(source: SourceFile, place: Place, guard: GuardTreatment) -> Found:
    treatment, does = guard.of(source, place)
    node = place.node
    return Found(
        source.path,
        node.lineno,
        node.col_offset + 1,
        place.rule.kind,
        place.call,
        treatment,
        does,
        place.rule.instead,
    )
