"""Audit a path or a job: from files to findings."""

from __future__ import annotations

import ast
import io
import os
import re
import sys
import tokenize
from collections.abc import Callable, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

from rsltrace.errors import JobError
from rsltrace.guard.audit.calls import CallSite, find_calls
from rsltrace.guard.audit.names import NameResolver
from rsltrace.guard.audit.scopes import ModuleSource, NameScope, parse_scopes
from rsltrace.guard.rules import Treatment
from rsltrace.job import Job, locate, policy_of
from rsltrace.trace.model.finding import GuardPolicy
from rsltrace.trace.model.module_search import find_module
from rsltrace.trace.model.regular_file import read_regular

# What an audit has found.


SAFE_TREATMENTS = frozenset({Treatment.VIRTUAL, Treatment.PINNED})
"""With these, a second run does the same."""


@dataclass(frozen=True, slots=True, order=True)
class AuditFinding:
    """One call in a source file; lines and columns count from 1, as in editors."""

    path: Path
    line: int
    column: int
    kind: str
    call: str
    treatment: Treatment
    does: str
    instead: str


@dataclass(frozen=True, slots=True)
class AuditReport:
    """The result of an audit. ``troubles`` names files that are not readable as Python, ``allowed``
    counts findings that a comment silences."""

    found: tuple[AuditFinding, ...]
    files: int
    troubles: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    allowed: int = 0


# Which files to read: those of a path, or those of a job's nodes and their imports.

_INSTALLED = {"site-packages", "dist-packages"}
_NOT_SOURCES = {"build", "install", "log", "node_modules", "__pycache__"}
_ALLOW = re.compile(r"#.*\brsltrace:\s*allow\b(?P<kinds>[\w ,\t-]*)")


@dataclass(eq=False)
class SourceFile:
    """A Python file to audit. ``allowed`` maps lines to the kinds that a comment allows; an empty
    set allows all."""

    path: Path
    module: ModuleSource
    as_script: bool = False
    allowed: dict[int, frozenset[str]] = field(default_factory=dict)


def read_source(path: Path, name: str, *, as_script: bool = False) -> SourceFile:
    """Parse a file.

    :raises OSError, SyntaxError, ValueError: if it is no Python source.
    """
    data = io.BytesIO(read_regular(path))
    encoding, _ = tokenize.detect_encoding(data.readline)
    data.seek(0)
    text = io.TextIOWrapper(data, encoding).read()
    tree = ast.parse(text, str(path))
    module = parse_scopes(tree, name, is_package=path.name == "__init__.py")
    return SourceFile(path, module, as_script, _allowed(text))


def _allowed(text: str) -> dict[int, frozenset[str]]:
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        match = _ALLOW.search(line)
        if match is not None:
            kinds = match["kinds"].split(" -", 1)[0]  # what follows a dash is the reason
            found[number] = frozenset(re.split(r"[\s,]+", kinds.strip())) - {""}
    return found


class SourceCollection:
    """Source files by module name, each once, and those that could not be read."""

    def __init__(self) -> None:
        self.files: dict[str, SourceFile] = {}
        self.troubles: list[str] = []
        self.notes: list[str] = []
        self._paths: set[Path] = set()

    def add(self, path: Path, name: str, *, as_script: bool = False) -> SourceFile | None:
        """Read a file that was not read yet, and return it."""
        real = path.resolve()
        if real in self._paths:
            return None
        self._paths.add(real)
        try:
            source = read_source(path, name, as_script=as_script)
        except SyntaxError as error:
            self.troubles.append(f"{path}:{error.lineno or 1}: not Python: {error.msg}")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            self.troubles.append(f"{path}: cannot be read: {reason}")
        else:
            unique = name
            while unique in self.files:
                unique += "'"  # two files of one name in different folders
            source.module.name = name
            self.files[unique] = source
            return source
        return None


def collect_path(path: Path) -> SourceCollection:
    """Return the Python file at a path, or those below a folder."""
    found = SourceCollection()
    if path.is_dir():
        for file in _python_files(path):
            found.add(file, module_name(file))
    else:
        found.add(path, module_name(path), as_script=True)
    return found


def _python_files(folder: Path) -> Iterator[Path]:
    for here, folders, files in os.walk(folder):
        if "pyvenv.cfg" in files:
            folders.clear()
            continue
        top = Path(here) == folder
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and not (name in _NOT_SOURCES and (top or name[0] == "_"))
        )
        yield from (Path(here, name) for name in sorted(files) if name.endswith(".py"))


def module_name(path: Path) -> str:
    """Return the full name of a file's module, its packages included."""
    path = path.absolute()
    parts = [] if path.name == "__init__.py" else [path.stem]
    folder = path.parent
    while (folder / "__init__.py").exists():
        parts.insert(0, folder.name)
        folder = folder.parent
    return ".".join(parts)


def collect_modules(
    names: Sequence[str],
    scripts: Sequence[Path],
    folders: Sequence[Path],
    programs: AbstractSet[str] = frozenset(),
) -> tuple[SourceCollection, list[str]]:
    """Return modules by name with the user's modules that they import, and the names not found.

    ``programs`` are the modules that ``python -m`` runs. The user's modules are those below
    ``folders`` (virtual environments excluded), and those of the same installed package.
    """
    found = SourceCollection()
    path = [*map(str, folders), *sys.path]
    missing = []
    waiting: list[tuple[str, str]] = [(name, name.partition(".")[0]) for name in names]
    for script in scripts:
        source = found.add(script, "__main__", as_script=True)
        if source is not None:
            waiting += [(name, "") for name in sorted(source.module.imports)]
            path.insert(0, str(script.parent))
    wanted = set(names)
    seen = set()
    while waiting:
        name, package = waiting.pop(0)
        if (name, package) in seen:
            continue
        seen.add((name, package))
        spec = find_module(name, path)
        if spec is None or spec.origin is None:
            if name in wanted and (spec is None or not spec.submodule_search_locations):
                missing.append(name)
            continue
        file = Path(spec.origin)
        if not _is_own(file, name, package, folders) and name not in wanted:
            continue
        if file.suffix != ".py":
            found.notes.append(f"{name} is compiled ({file.name}): it cannot be looked at")
            continue
        source = found.add(file, name, as_script=name in programs)
        if source is not None:
            parents = [name.rsplit(".", up)[0] for up in range(1, name.count(".") + 1)]
            imports = [*parents, *sorted(source.module.imports)]
            waiting += [(one, package) for one in imports]
    return found, missing


def _is_own(file: Path, name: str, package: str, folders: Sequence[Path]) -> bool:
    if _INSTALLED & set(file.parts):
        return bool(package) and name.partition(".")[0] == package
    return any(file.is_relative_to(folder) for folder in folders) or (
        bool(package) and name.partition(".")[0] == package
    )


# What the guard does about a call site depends on the policy of the job or of the node that runs
# it. Code at the top of a module runs under the job's, since no node exists yet; code in a node's
# class under the node's; any other function under that of each node whose imports lead to it.

_LEAST_SAFE_FIRST = (
    Treatment.NOTHING,
    Treatment.DETECTED,
    Treatment.RECORDED,
    Treatment.REFUSED,
    Treatment.PINNED,
    Treatment.VIRTUAL,
)


@dataclass
class _NodeGroup:
    """Nodes with equal policies, with their targets (``module:Class`` or scripts) and files."""

    policy: GuardPolicy
    whose: str
    targets: list[str | Path]
    files: frozenset[Path] = frozenset()


class GuardTreatment:
    """Returns what the guard does about a call site. ``policy`` is the job's; None: no guard."""

    def __init__(self, policy: GuardPolicy | None, groups: Sequence[_NodeGroup] = ()) -> None:
        self._policy = policy
        self._groups = groups

    @classmethod
    def of_job(
        cls, job: Job, targets: Sequence[str | Path], folders: Sequence[Path]
    ) -> GuardTreatment:
        """Return the treatment by the guards of a job and its nodes, which have ``targets``."""
        if not job.guard.enabled:
            return cls(None)
        of_job = policy_of(job.guard)
        if all(spec.guard is None for spec in job.nodes):
            return cls(of_job)
        groups: list[_NodeGroup] = []
        for spec, target in zip(job.nodes, targets, strict=True):
            policy, whose = of_job, "the job"
            if spec.guard is not None:
                policy, whose = policy_of(job.guard, spec.guard), f"node {spec.name or spec.target}"
            group = next((one for one in groups if one.policy == policy), None)
            if group is None:
                groups.append(group := _NodeGroup(policy, whose, []))
            group.targets.append(target)
        for group in groups:
            names = [module_of(target) for target in group.targets if isinstance(target, str)]
            scripts = [target for target in group.targets if isinstance(target, Path)]
            reached, _ = collect_modules(names, scripts, folders)
            group.files = frozenset(one.path.resolve() for one in reached.files.values())
        return cls(of_job, groups)

    def of(self, source: SourceFile, place: CallSite) -> tuple[Treatment, str]:
        """Return the treatment of a call site and its meaning; of several, the least safe."""
        groups = self._that_get_to(source, place)
        if not groups:
            return _treatment(source, place, self._policy, "the job")
        all_done = [_treatment(source, place, group.policy, group.whose) for group in groups]
        least = min(all_done, key=lambda done: _LEAST_SAFE_FIRST.index(done[0]))
        group = groups[all_done.index(least)]
        treatment, does = least
        other = next((done for done in all_done if done[0] is not treatment), None)
        if other is None:
            return least
        runs_in = "" if group.whose in does else f" when {group.whose} runs it"
        return treatment, f"{does}{runs_in} ({other[0].value} elsewhere)"

    def _that_get_to(self, source: SourceFile, place: CallSite) -> Sequence[_NodeGroup]:
        scope: NameScope | None = source.module.scope_of(place.node)
        if scope is source.module.top or not self._groups:
            return ()
        while scope is not None and scope.parent is not source.module.top:
            scope = scope.parent
        name = f"{source.module.name}:{getattr(scope and scope.node, 'name', '')}"
        own = [group for group in self._groups if name in group.targets]
        path = source.path.resolve()
        return own or [group for group in self._groups if path in group.files]


def module_of(target: str) -> str:
    """Return the module of ``module:name``."""
    return target.partition(":")[0]


def _treatment(
    source: SourceFile, place: CallSite, policy: GuardPolicy | None, whose: str
) -> tuple[Treatment, str]:
    rule = place.rule
    globs = policy.allowed.get(rule.source, ()) if policy and rule.source else ()
    if any(fnmatchcase(source.module.name, glob) for glob in globs):
        return Treatment.NOTHING, f"{whose} allows it to this module"
    return rule.treated(policy, whose)


Executables = Callable[[str, str], "str | Path"]
"""Maps ``package/executable``, and where it is written, to ``module:function`` or a script."""
ModuleFolders = Callable[[Iterable[Path]], list[Path]]


def audit_path(path: Path) -> AuditReport:
    """Audit a Python file, or all files below a folder, with the guard's defaults.

    :raises JobError: if there is nothing to audit.
    """
    if not path.exists():
        raise JobError(f"{path}: there is no such file or folder")
    found = collect_path(path)
    if not found.files and not found.troubles:
        raise JobError(f"{path}: there is no Python file in this folder")
    return _audit(found, GuardTreatment(GuardPolicy()))


def audit_job(
    job: Job, executable: Executables, module_folders: ModuleFolders | None = None
) -> AuditReport:
    """Audit the modules of a job's nodes, and their imports below its search path.

    ``module_folders`` returns the folders of the modules of packages' executables.

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
    if module_folders and any(spec.executable is not None for spec in job.nodes):
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


def _audit(collection: SourceCollection, guard: GuardTreatment) -> AuditReport:
    sources = list(collection.files.values())
    names = NameResolver({source.module.name: source.module for source in sources})
    called: set[ast.AST] = set()
    places: list[tuple[SourceFile, CallSite]] = []
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
        found.add(_finding(source, place, guard))
    return AuditReport(
        tuple(sorted(found)),
        len(sources),
        tuple(collection.troubles),
        tuple(collection.notes),
        silenced,
    )


def _is_silenced(source: SourceFile, place: CallSite) -> bool:
    first = place.node.lineno
    last = first if isinstance(place.node, ast.stmt) else place.node.end_lineno or first
    for line in range(first, last + 1):
        kinds = source.allowed.get(line)
        if kinds is not None and (not kinds or place.rule.kind in kinds):
            return True
    return False


def _finding(source: SourceFile, place: CallSite, guard: GuardTreatment) -> AuditFinding:
    treatment, does = guard.of(source, place)
    node = place.node
    return AuditFinding(
        source.path,
        node.lineno,
        node.col_offset + 1,
        place.rule.kind,
        place.call,
        treatment,
        does,
        place.rule.instead,
    )
