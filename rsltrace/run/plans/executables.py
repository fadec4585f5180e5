"""Find what ``main:``, ``executable:``, ``script:`` and ``module:`` run.

An executable is a console script of a Python distribution, a Python script that a ROS package
installs (``lib/<package>/<executable>`` below a prefix of the ament index), or what an unbuilt
package would install as such. All run unchanged in this process.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.machinery import ModuleSpec, SourceFileLoader
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

from rsltrace.adapters.processes.build import is_compiled, is_python, why_not_run
from rsltrace.adapters.rclpy.boundary.boundary import NeedsItsProcess, before_its_process
from rsltrace.adapters.rclpy.boundary.installation import boundary
from rsltrace.adapters.rclpy.hints import cannot_import, import_raised
from rsltrace.adapters.workspace.imports import (
    unbuilt_executables,
    unbuilt_fault,
    unbuilt_names,
    unbuilt_programs,
)
from rsltrace.errors import JobError, nearest
from rsltrace.fast_dataclass import dataclass
from rsltrace.guard.virtual.user_modules import code_of_script
from rsltrace.job import Job, NodeSpec
from rsltrace.job.reading.substitute import installed_prefixes
from rsltrace.run.plans.scheduling import load_target
from rsltrace.run.process import COPIED_FILES, run_as_main, user_modules
from rsltrace.simulation.middleware.events.failure import exception_text
from rsltrace.trace.model.regular_file import read_regular

# Scripts and modules run as ``__main__``, in a module of that name of their own. So
# ``unittest.main()``, ``pickle`` and ``dataclasses`` find what the program defines.


@dataclass(frozen=True)
class MainProgram:
    """Code to run as ``__main__``. Python looks for its modules in ``folder`` first; ``spec`` is
    None for a script."""

    path: Path
    code: CodeType
    folder: str
    spec: ModuleSpec | None = None

    def __post_init__(self) -> None:
        """Say what it runs: traces name the program's file then, not this one."""
        names = {} if self.spec is None else {"__name__": self.spec.name}
        vars(self)["__wrapped__"] = FunctionType(self.code, names)

    def __call__(self) -> None:
        """Run the program as ``__main__``."""
        names = vars(sys.modules["__main__"])
        spec = self.spec
        names.update(
            __file__=str(self.path),
            __cached__=None if spec is None else spec.cached,
            __loader__=SourceFileLoader("__main__", str(self.path))
            if spec is None
            else spec.loader,
            __package__=None if spec is None else spec.parent,
            __spec__=spec,
        )
        sys.path.insert(0, self.folder)
        exec(self.code, names)


def script_program(path: Path, *, what: str = "", where: str) -> MainProgram:
    """Return a script to run as ``python script.py`` does; ``what`` is its name for messages.

    :raises JobError: if it cannot be read, or is not Python.
    """
    what = what or str(path)
    try:
        code = code_of_script(read_regular(path), str(path))
    except OSError as error:
        raise JobError(f"{what} cannot be read: {error.strerror}", where=where) from None
    except (SyntaxError, ValueError) as error:
        raise JobError(f"{what} is not a Python program ({error})", where=where) from None
    return MainProgram(path, code, str(path.resolve().parent))


def module_program(name: str, folder: Path, *, where: str) -> MainProgram:
    """Return a module to run as ``python -m name`` does in ``folder``; imports its packages.

    :raises JobError: there is no such module, or it is not Python source.
    """
    try:
        spec = run_as_main(name)
    except ModuleNotFoundError as error:
        parent = name.rpartition(".")[0]
        if not f"{parent}.".startswith(f"{error.name}."):
            raise JobError(cannot_import(parent, error), where=where) from error
        spec = None
    except (Exception, SystemExit) as error:
        raised = import_raised(name.rpartition(".")[0], error, exception_text(error))
        raise JobError(raised, where=where) from error
    if spec is None:
        raise JobError(
            f"there is no module {name!r} to run (looked in search_path and in Python's own path; "
            "of a package its module __main__ runs); check the name, or add its folder to "
            "search_path",
            where=where,
        )
    get_code = getattr(spec.loader, "get_code", None)
    try:
        code = None if get_code is None else get_code(spec.name)
    except (ImportError, SyntaxError, ValueError) as error:
        raise JobError(f"module {name!r} cannot be compiled: {error}", where=where) from error
    if code is None or spec.origin is None:
        raise JobError(f"module {name!r} is no Python source: it cannot be run", where=where)
    return MainProgram(Path(spec.origin), code, str(folder), spec)


class MainFinder:
    """Finds the mains of a job. Each has its package's globals to itself, as a process has."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._packages: set[str] = set()

    def find(self, spec: NodeSpec, *, where: str) -> tuple[str, Callable[[], object]]:
        """Return ``sys.argv[0]`` and the function to call.

        :raises JobError: it does not exist, or is not Python.
        """
        if spec.executable is not None:
            found = find_executable(spec.executable, where=where)
            name = spec.executable.partition("/")[2]
            if isinstance(found, str):
                with _command_line(name, spec):
                    return name, self._load(found, where)
            return name, found
        if spec.script is not None:
            script = script_program(self._job.resolve(spec.script), what=spec.script, where=where)
            return str(script.path), script
        if spec.module is not None:
            with _command_line(spec.module, spec), self._copied(spec.package):
                program = module_program(spec.module, self._job.base_dir, where=where)
            return str(program.path), program
        assert spec.main is not None
        if isinstance(spec.main, str):
            name = spec.main.partition(":")[0].rpartition(".")[2]
            with _command_line(name, spec):
                return name, self._load(spec.main, where)
        return getattr(spec.main, "__name__", type(spec.main).__name__), spec.main

    def _load(self, target: str, where: str) -> Callable[[], object]:
        """Import a main's module now, or when its program starts if it uses rclpy's contexts."""
        package = re.split("[.:]", target)[0]
        again = package in self._packages
        before = set(sys.modules)
        try:
            with self._copied(package), self._without_process():
                function: Callable[[], object] = load_target(target, where=where)
        except NeedsItsProcess:
            folders = [str(self._job.resolve(folder)) for folder in self._job.search_path]
            for name in user_modules(folders).keys() - before:
                del sys.modules[name]
            return DeferredMain(target, again=again)
        return function

    def _without_process(self) -> AbstractContextManager[None]:
        """Import without a process of rclpy; in a native run it is the main's process."""
        return nullcontext() if boundary().is_free else before_its_process()

    def _copied(self, package: str) -> AbstractContextManager[None]:
        """Import a package again if another main has imported it."""
        again = package in self._packages
        self._packages.add(package)
        return _imported_again(package) if again else nullcontext()


class DeferredMain:
    """A main whose module is imported when it starts, in its own program."""

    def __init__(self, target: str, *, again: bool) -> None:
        """``again``: another main has imported the module, too."""
        self._target = target
        self._again = again

    def __call__(self) -> object:
        module, _, name = self._target.partition(":")
        package = module.partition(".")[0]
        again, self._again = self._again, True  # a program that is restarted imports it once more
        with _imported_again(package) if again else nullcontext():
            function = attrgetter(name)(importlib.import_module(module))
        return function()


@contextmanager
def _command_line(name: str, spec: NodeSpec) -> Iterator[None]:
    """Set ``sys.argv`` during an import: ``def main(args=sys.argv):``."""
    before = sys.argv
    sys.argv = [name, *spec.arguments]
    try:
        yield
    finally:
        sys.argv = before


@contextmanager
def _imported_again(package: str) -> Iterator[None]:
    """Import a package a second time; those that have it keep their copy."""

    def modules() -> dict[str, ModuleType]:
        return {
            name: module
            for name, module in sys.modules.items()
            if name == package or name.startswith(package + ".")
        }

    before = modules()
    for name in before:
        del sys.modules[name]
    try:
        yield
    finally:
        for name, module in modules().items():
            del sys.modules[name]
            if isinstance(file := getattr(module, "__file__", None), str):
                COPIED_FILES[name] = file
        sys.modules.update(before)


def why_not_runnable(package: str, name: str) -> str | None:
    """Return why an executable cannot run here, or None. Nothing is imported."""
    compiled = compiled_file(f"{package}/{name}")
    if compiled is not None:
        reason = why_not_run(compiled)
        return f"{package}/{name} {reason}" if reason else None
    try:
        find_executable(f"{package}/{name}", where="")
    except JobError as error:
        return str(error)
    return None


def executable_source(target: str, *, where: str) -> str | Path:
    """Return the code of an executable: ``module:function``, or a script.

    :raises JobError: as ``find_executable``.
    """
    found = find_executable(target, where=where)
    if isinstance(found, str):
        return found
    file = executable_file(target)
    assert file is not None, "find_executable has read it"
    return file


def executable_file(target: str) -> Path | None:
    """Return the script or compiled program that is ``package/name``, None if it is a function."""
    package, _, name = target.partition("/")
    if name in _console_scripts(package):
        return None
    files = {**unbuilt_executables(package), **_installed_files(package)}
    found = files.get(name)
    return found if isinstance(found, Path) else None


def find_executable(target: str, *, where: str) -> str | Callable[[], object]:
    """Return what runs ``package/name``: a function, or its name (``module:function``).

    :raises JobError: if the package or the executable is unknown, or not Python.
    """
    package, _, name = target.partition("/")
    scripts = _console_scripts(package)
    if name in scripts:
        return scripts[name]
    files = _installed_files(package)
    if name in files:
        return _python_script(files[name], target, where)
    sources = unbuilt_executables(package)
    if name in sources:
        source = sources[name]
        return source if isinstance(source, str) else _python_script(source, target, where)
    known = _packages() | unbuilt_names()
    if not scripts and not files and package not in known:
        raise JobError(
            f"there is no package {package!r}{_did_you_mean_or(package, known, 'install')} it for "
            "this Python (pip install), add its sources to search_path, or source the workspace "
            "it is built in",
            where=where,
        )
    available = sorted({*scripts, *files, *sources})
    compiled = unbuilt_programs(package)
    if name in compiled:
        raise JobError(
            f"{target} is a program that is not built (CMakeLists.txt of {package}): build it "
            "(colcon build) and source its workspace (install/setup.bash)",
            where=where,
        )
    has = f"has {', '.join(available[:10])}" if available else "has none"
    if compiled:
        listed = ", ".join(sorted(compiled)[:10])
        has += f"; once it is built (colcon build): {listed}"
    if fault := unbuilt_fault(package):
        has += f"; {fault}"
    it = _did_you_mean_or(name, {*available, *compiled}, "it")
    raise JobError(f"package {package!r} has no executable {name!r}{it} {has}", where=where)


def compiled_file(target: str) -> Path | None:
    """Return the file of ``package/name`` if it is a compiled program, else None."""
    path = executable_file(target)
    return path if path is not None and is_compiled(path) else None


def process_command(target: str, *, where: str) -> list[str]:
    """Return the command that starts ``package/name`` as a process: the installed file, or else the
    code that it would run.

    :raises JobError: there is no such executable.
    """
    package, _, name = target.partition("/")
    found: str | Path | None = _installed_files(package).get(name)
    if found is None and name in _console_scripts(package):
        found = Path(sys.executable).parent / name
    if found is None or not Path(found).is_file():
        found = executable_source(target, where=where)
    if isinstance(found, str):
        module, _, function = found.partition(":")
        code = (
            f"import sys, importlib; sys.argv[0] = {name!r}; "
            f"sys.exit(importlib.import_module({module!r}).{function}())"
        )
        return [sys.executable, "-c", code]
    return [sys.executable, str(found)] if is_python(found) else [str(found)]


def _normalized(name: str) -> str:
    """Return a distribution's name in the normalized form of package indexes."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _console_scripts(package: str) -> dict[str, str]:
    """Return ``module:function`` of a distribution's console scripts, by name."""
    found: dict[str, str] = {}
    from importlib import metadata

    for entry in metadata.entry_points(group="console_scripts"):
        if entry.dist is not None and _normalized(entry.dist.name) == _normalized(package):
            found.setdefault(entry.name, f"{entry.module}:{entry.attr}")
    return found


def _installed_files(package: str) -> dict[str, Path]:
    """Return the executable files of a ROS package, by name."""
    found: dict[str, Path] = {}
    for prefix in installed_prefixes():
        folder = prefix / "lib" / package
        if not (prefix / "share/ament_index/resource_index/packages" / package).exists():
            continue
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            if path.is_file() and os.access(path, os.X_OK):
                found.setdefault(path.name, path)
    return found


def _packages() -> set[str]:
    """Return the names of all installed packages."""
    from importlib import metadata

    names = {dist.name for dist in metadata.distributions() if dist.name}
    names |= {name.replace("-", "_") for name in names}
    for prefix in installed_prefixes():
        index = prefix / "share/ament_index/resource_index/packages"
        names |= {path.name for path in index.iterdir()} if index.is_dir() else set()
    return names


def _did_you_mean_or(name: str, names: Iterable[str], word: str) -> str:
    """Return ``; did you mean 'talker'? It``, or ``: it`` if no name is near."""
    near = nearest(name, sorted(names))
    if near in (None, name):
        return f": {word}"
    return f"; did you mean {near!r}? {word.capitalize()}"


def _python_script(path: Path, target: str, where: str) -> MainProgram:
    with path.open("rb") as file:
        first = file.readline(256)
    if is_compiled(path):
        what = "a compiled program"
    elif first.startswith(b"#!") and b"python" not in first:
        what = f"a script for {first[2:].decode(errors='replace').strip()}"
    else:
        return script_program(path, what=target, where=where)
    raise JobError(
        f"{target} is {what} ({path.name}): rsltrace runs Python nodes only; leave it out, or feed "
        "the graph what it publishes from a bag",
        where=where,
    )
