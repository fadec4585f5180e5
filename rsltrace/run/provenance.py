"""What a trace says of its origin: job, environment, code and kept payloads."""

from __future__ import annotations

import ast
import hashlib
import json
import math
import os
import platform
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import suppress
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from rsltrace._version import __version__
from rsltrace.adapters.processes.build import PRELOADED, is_python
from rsltrace.guard.callers import is_rsltrace_module, is_user_file
from rsltrace.guard.pin import HASH_SEED, import_threadpoolctl
from rsltrace.job import Job
from rsltrace.job.reading.substitute import installed_prefixes
from rsltrace.job.values.checks import Target
from rsltrace.run.plans.executables import executable_file
from rsltrace.run.process import (
    COPIED_FILES,
    is_below,
    is_pytest_module,
    python_path,
    run_as_main,
    user_modules,
)
from rsltrace.trace.format import (
    ATTACHMENT_JOB,
    METADATA_CODE,
    METADATA_JOB,
    METADATA_SOURCES,
    PREFIX_REQUEST,
    PREFIX_RESPONSE,
)
from rsltrace.trace.writer import TraceWriter

# numpy, OpenBLAS and similar libraries round differently on different processors. A trace names
# their kernels, but only if the job's modules use such libraries.

_LIBC = "CS_GNU_LIBC_VERSION"
_LIBRARIES = frozenset(
    "numpy scipy pandas cv2 torch tensorflow jax numba sklearn casadi cvxpy filterpy pinocchio "
    "shapely skimage".split()
)


def numerical_libraries(job: Job) -> str:
    """Return the libraries with version and kernel, or "" if the job uses none.

    The nodes' modules are already imported. ``LateLibraryScan`` finds later imports.
    """
    return _kernels() if any(map(_uses_numbers, _modules(job))) else ""


class LateLibraryScan:
    """Finds numerical libraries that are imported during the run, by mains or test suites."""

    def __init__(self, programs: Iterable[CodeType]) -> None:
        self._before = set(sys.modules)
        self._programs = tuple(programs)

    def find(self) -> str:
        """Return what ``numerical_libraries`` does, for modules that user code has loaded since."""
        loaded = [sys.modules.get(name) for name in sorted(set(sys.modules) - self._before)]
        of_user = [one for one in loaded if one is not None and _is_of_user(one)]
        if any(map(_uses_numbers, of_user)) or any(map(_imports_numbers, self._programs)):
            return _kernels()
        return ""


def _kernels() -> str:
    keys = ("internal_api", "version", "architecture")
    found = {
        " ".join(str(pool[key]) for key in keys if pool.get(key))
        for pool in import_threadpoolctl().threadpool_info()
    }
    return ", ".join(sorted(found | {_numpy_kernels()}))


def _numpy_kernels() -> str:
    """Return the instructions numpy's own functions use: it sorts and rounds by them, too."""
    core: Any = sys.modules.get("numpy._core._multiarray_umath")  # from numpy 2 on
    core = core or sys.modules["numpy.core._multiarray_umath"]
    return " ".join(["numpy", *filter(core.__cpu_features__.get, core.__cpu_dispatch__)])


@lru_cache(maxsize=1)
def _math_functions() -> str:
    """Return the C library's version, and a checksum of what its functions give: they round by the
    instructions of the processor."""
    names = getattr(os, "confstr_names", {})
    version = os.confstr(_LIBC) if _LIBC in names else None
    numbers = [1 + n / 7.3 for n in range(300)]
    found = [[math.pow(x, 1.7), math.log2(x), math.exp(-x), math.sin(x)] for x in numbers]
    return f"{version or 'libc'}, rounding {zlib.crc32(repr(found).encode()):08x}"


def _is_of_user(module: ModuleType) -> bool:
    file = getattr(module, "__file__", None)
    return isinstance(file, str) and not is_rsltrace_module(module.__name__) and is_user_file(file)


def _imports_numbers(code: CodeType) -> bool:
    return any(name.partition(".")[0] in _LIBRARIES for name in code.co_names) or any(
        _imports_numbers(part) for part in code.co_consts if isinstance(part, CodeType)
    )


def _modules(job: Job) -> Iterable[ModuleType]:
    """Return the loaded user modules: of the search path, or of a node's package."""
    names = set(user_modules([str(job.resolve(folder)) for folder in job.search_path]))
    packages = {spec.package for spec in job.nodes} - {""}
    names |= {name for name in sys.modules if name.partition(".")[0] in packages}
    return [sys.modules[name] for name in sorted(names)]


def _uses_numbers(module: ModuleType) -> bool:
    """Whether a module has values of the libraries, or a function that imports one."""
    file = getattr(module, "__file__", None)
    for value in list(vars(module).values()):
        name = value.__name__ if isinstance(value, ModuleType) else _module_of_value(value)
        if name.partition(".")[0] in _LIBRARIES:
            return True
        functions = vars(value).values() if isinstance(value, type) else (value,)
        for one in functions:
            code = one.__code__ if type(one) is FunctionType else None
            if code is not None and code.co_filename == file and _imports_numbers(code):
                return True
    return False


def _module_of_value(value: object) -> str:
    """Return the module of a function or class, or ""."""
    if not isinstance(value, type) and not callable(value):
        return ""
    name = getattr(value, "__module__", "")
    return name if isinstance(name, str) else ""


def module_code(modules: Mapping[str, Path], late: Container[str] = ()) -> dict[str, str]:
    """Return, as JSON for each Python module, the ``hash`` of its syntax tree, its ``imports`` of
    the other modules, and if it is ``late``; for YAML and definitions of interfaces the ``hash`` of
    all but comments and layout."""
    found = {}
    for name, path in modules.items():
        try:
            if (text := _without_comments(path)) is not None:
                found[name] = json.dumps({"hash": _hash(text.encode("utf-8", "surrogatepass"))})
                continue
            if not is_python(path):
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Python has said it when it compiled them
                tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
            continue
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        begins = tuple(_named_later(tree))
        later = {one for one in modules if ":" not in one and one.startswith(begins)}
        imports = sorted(({*_imported(tree, package)} & {*modules} | later) - {name})
        digest = _hash(ast.dump(tree).encode("utf-8", "surrogatepass"))
        code: dict[str, object] = {"hash": digest, "imports": imports}
        found[name] = json.dumps(code | ({"late": True} if name in late else {}))
    return found


def _without_comments(path: Path) -> str | None:
    """Return what a file of YAML or a definition of an interface says; None for other files."""
    if path.suffix in _DEFINITIONS:
        lines = path.read_text("utf-8", "replace").splitlines()
        words = (line.partition("#")[0].split() for line in lines)
        return "\n".join(" ".join(line) for line in words if line)
    if path.suffix in _YAML:
        import yaml  # type: ignore[import-untyped]  # rclpy's, which most runs do not need

        try:
            return "".join(map(repr, yaml.parse(path.read_bytes())))
        except yaml.YAMLError:
            return None
    return None


def _named_later(tree: ast.Module) -> Iterator[str]:
    """Yield how the names begin that ``import_module`` and the like are called with: "" if that is
    not known."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args:
            called = getattr(node.func, "attr", None) or getattr(node.func, "id", "")
            first: ast.AST = node.args[0]
            while isinstance(first, ast.BinOp | ast.JoinedStr):
                first = first.left if isinstance(first, ast.BinOp) else (first.values or [node])[0]
            if called in _IMPORTERS:
                text = str(first.value) if isinstance(first, ast.Constant) else ""
                yield "" if text.startswith(".") else text


def _imported(tree: ast.Module, package: str) -> Iterator[str]:
    """Yield the modules that may be imported, with their parent packages."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(parents if node.level else []), *filter(None, [node.module])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[:count]) for count in range(1, len(parts) + 1))


_LIBRARIES_OF_ROS = ("librcl.so", "librclcpp.so")
_IMPORTERS = ("import_module", "__import__")
_YAML = (".yaml", ".yml")
_DEFINITIONS = (".msg", ".srv", ".action")
_PACKAGES = ("rclpy", "numpy", "scipy", "rosbags", "mcap", "xxhash")


def payload_filter(job: Job) -> Callable[[str], bool]:
    """Return the function that decides whether a topic's payloads are kept."""
    spec = job.record

    def keep(topic: str) -> bool:
        name = topic
        for prefix in (PREFIX_REQUEST, PREFIX_RESPONSE):
            name = name.removeprefix(prefix)
        return (
            spec.payloads
            and any(fnmatchcase(name, glob) for glob in spec.topics)
            and not any(fnmatchcase(name, glob) for glob in spec.exclude)
        )

    return keep


def write_job(writer: TraceWriter, job: Job) -> None:
    """Write the job's text and its resolved form into the trace."""
    resolved = json.dumps(job.resolved(), sort_keys=True, ensure_ascii=False)
    name = Path(job.source_name).name
    writer.add_metadata(METADATA_JOB, {"name": name, "resolved": resolved})
    writer.add_attachment(ATTACHMENT_JOB, "application/yaml", job.source_text.encode())


def source_files(job: Job) -> dict[str, Path]:
    """Return the files of ``loaded_modules``, and the job's scripts, programs, executables,
    libraries of components, files of parameters, terminal input and models (``file:`` and what the
    job calls them)."""
    modules = loaded_modules(job)
    modules.update(_run_as_main(job))
    modules.update(_input_files(job))
    modules.update(_interface_files())
    modules.update({f"file:{path}": job.resolve(path) for _, path in job.model_files()})
    return modules


def _interface_files() -> Iterator[tuple[str, Path]]:
    """Yield the definitions in the loaded packages of interfaces that are not ROS's own."""
    ros = getattr(sys.modules.get("rclpy"), "__file__", None) or os.sep
    for name, module in list(sys.modules.items()):
        package, _, kind = name.partition(".")
        file = getattr(module, "__file__", None)
        if f".{kind}" not in _DEFINITIONS or not isinstance(file, str):
            continue
        for prefix in Path(file).parents:
            folder = prefix / "share" / package / kind
            if folder.is_dir():
                if not Path(ros).is_relative_to(prefix):
                    for path in sorted(folder.glob(f"*.{kind}")):
                        yield f"file:{package}/{kind}/{path.name}", path
                break


def loaded_modules(job: Job) -> dict[str, Path]:
    """Return the files of all modules loaded from the job's search path or ``PYTHONPATH``, by name;
    also those of its entries' packages where they are installed, in a sourced workspace or with
    pip.

    Test modules are left out unless a node is in one.
    """
    folders = [*map(str, map(job.resolve, job.search_path)), *map(str, python_path())]
    of_nodes = {_module_of(target) for spec in job.nodes for target in (spec.node, spec.main)}
    copied = {name: Path(file) for name, file in COPIED_FILES.items() if is_below(file, folders)}
    return {
        name: path
        for name, path in {**copied, **_of_workspace(job), **user_modules(folders)}.items()
        if name in of_nodes or not is_pytest_module(name)
    }


def _of_workspace(job: Job) -> dict[str, Path]:
    """Return the files of the loaded modules of entries' packages that are installed."""
    packages = {spec.package for spec in job.nodes} - {"", *_PACKAGES}
    prefixes = tuple(map(str, installed_prefixes())) if packages else ()
    files = {
        name: getattr(module, "__file__", None)
        for name, module in sys.modules.items()
        if name.partition(".")[0] in packages
    }
    files.update((name, f) for name, f in COPIED_FILES.items() if name.split(".")[0] in packages)
    return {
        name: Path(file)
        for name, file in sorted(files.items())
        if isinstance(file, str) and any(map(Path(file).is_relative_to, prefixes))
    }


class SourceHashes:
    """Writes hashes of code files and of their syntax trees into a trace, anew when a run has
    loaded more: a reader takes the last."""

    def __init__(self, writer: TraceWriter, files: Mapping[str, Path]) -> None:
        self._writer = writer
        self._files: dict[str, Path] = {}
        self._hashes: dict[str, str] = {}
        self._late: set[str] = set()
        self._written: set[str] | None = None
        self._loaded = _loaded_names()
        self.add(files)

    def add_loaded(self, job: Job, *, late: bool = False) -> None:
        """Add the modules of a job that have been loaded since."""
        if (loaded := _loaded_names()) != self._loaded:  # to look at all their files takes long
            self._loaded = loaded
            self.add({**loaded_modules(job), **dict(_interface_files())}, late=late)

    def add(self, files: Mapping[str, Path], *, late: bool = False) -> None:
        """Add the files that are new. ``late``: callbacks have loaded them, which they may do in
        one run and not in another of the same code."""
        for name in files.keys() - self._files.keys():
            with suppress(OSError):  # it has been removed since, or is in an archive
                self._hashes[name] = _hash(files[name].read_bytes())
                self._files[name] = files[name]
                self._late |= {name} if late else set()
        if self._hashes.keys() != self._written:
            self._write()

    def _write(self) -> None:
        self._written = set(self._hashes)
        self._writer.add_metadata(METADATA_SOURCES, self._hashes)
        if code := module_code(self._files, self._late):
            self._writer.add_metadata(METADATA_CODE, code)


def _loaded_names() -> set[str]:
    return sys.modules.keys() | COPIED_FILES.keys()


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _run_as_main(job: Job) -> Iterator[tuple[str, Path]]:
    """Yield the files that run as ``__main__`` and are not loaded modules."""
    folders = [str(job.resolve(folder)) for folder in job.search_path]
    for spec in job.nodes:
        file = spec.script or spec.program
        if spec.executable is not None:
            if (found_file := executable_file(spec.executable)) is not None:
                yield f"file:{spec.executable}", found_file
        elif file is not None:
            yield f"file:{file}", job.resolve(file)
        elif spec.component is not None:
            if (library := _library_of(spec.component)) is not None:
                yield f"file:{library.name}", library
        elif spec.module is not None:
            found = run_as_main(spec.module)
            if found is not None and is_below(found.origin or "", folders):
                yield found.name, Path(found.origin or "")


def _library_of(component: str) -> Path | None:
    """Return the library that a container loads for a component, as ament's index has it."""
    package, _, plugin = component.partition("/")
    for prefix in installed_prefixes():
        with suppress(OSError):
            index = prefix / "share/ament_index/resource_index/rclcpp_components" / package
            for line in index.read_text(errors="replace").splitlines():
                name, _, library = line.partition(";")
                if name == plugin:
                    return prefix / library
    return None


def own_libraries(job: Job, files: Iterable[str]) -> dict[str, Path]:
    """Return which code files are libraries and plugins of the job's folders, of a workspace or of
    ``LD_LIBRARY_PATH``, by ``file:`` and their names: none of the system, of ROS or of rsltrace."""
    prefixes = installed_prefixes()
    listed = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    folders = [
        *map(str, map(job.resolve, job.search_path)),
        *map(str, prefixes),
        *filter(None, listed),
    ]
    found = {}
    for path in map(Path, sorted(files)):
        if ".so" not in path.name or path.name in PRELOADED:
            continue
        if any((path.parent / name).exists() for name in _LIBRARIES_OF_ROS):
            continue
        # A workspace may have links to where its packages are built.
        linked = any((prefix / "lib" / path.name).exists() for prefix in prefixes)
        if linked or is_below(str(path), folders):
            found[f"file:{path.name}"] = path
    return found


def _input_files(job: Job) -> Iterator[tuple[str, Path]]:
    paths = [path for spec in job.nodes for path in spec.parameter_files]
    paths += [one.file for spec in job.nodes for one in spec.stdin or () if one.file is not None]
    for words in (job.ros_arguments, *(spec.arguments for spec in job.nodes)):
        paths += [path for flag, path in pairwise(words) if flag == "--params-file"]
    for path in paths:
        file = job.resolve(path)
        if file.is_file():
            yield f"file:{os.path.relpath(file, job.base_dir)}", file


def _module_of(target: Target | None) -> str:
    named = target if isinstance(target, str) else getattr(target, "__module__", "")
    return named.partition(":")[0]


@lru_cache(maxsize=1)
def _versions() -> tuple[tuple[str, str], ...]:
    """Return the versions of the packages that matter.

    It reads metadata itself: loading ``importlib.metadata`` takes as long as a small job.
    """
    found: dict[str, str] = {}
    for folder in sys.path:
        with suppress(OSError):
            for name in sorted(os.listdir(folder or os.curdir)):
                package = name.partition("-")[0].lower()
                if package in _PACKAGES and package not in found:
                    found.update((package, version) for version in _version_in(folder, name))
    return tuple((package, found[package]) for package in _PACKAGES if package in found)


def _version_in(folder: str, name: str) -> Iterator[str]:
    """Yield the version in a package's metadata."""
    files = {".dist-info": ("METADATA",), ".egg-info": ("PKG-INFO", "")}
    for file in files.get(os.path.splitext(name)[1], ()):
        with suppress(OSError):
            text = Path(folder, name, file).read_text("utf-8", "replace")
            head = text.partition("\n\n")[0].splitlines()
            lines = (line.partition(":") for line in head)
            yield from (value.strip() for key, _, value in lines if key.lower() == "version")


_DIGITS_MAX = 4300
"""Of whole numbers that Python reads or writes, unless it is told otherwise."""


def _python_options() -> str:
    """Return the options of Python that change what programs do, "" if there are none."""
    flags = sys.flags
    digits = getattr(sys, "get_int_max_str_digits", lambda: _DIGITS_MAX)()  # from 3.10.7 on
    found = {
        f"-O{flags.optimize}": flags.optimize,
        "-b": flags.bytes_warning,
        "-X dev": flags.dev_mode,
        "-X no_debug_ranges": "no_debug_ranges" in sys._xoptions,
        f"-X int_max_str_digits={digits}": digits != _DIGITS_MAX,
    }
    found.update(
        (f"-W error::{getattr(kind, '__name__', kind)}", True)
        for action, _, kind, *_ in warnings.filters
        if action == "error"
    )
    return " ".join(option for option, is_set in found.items() if is_set)


def environment(job: Job | None = None) -> dict[str, str]:
    """Return what a run's result may depend on: versions, never dates, names or paths.

    For a job whose modules (already imported) use numerical libraries, also their kernels.
    """
    values = {
        "rsltrace": __version__,
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "machine": platform.machine(),
        "system": platform.system(),
        "hash_seed": os.environ.get(HASH_SEED, "random"),
        "math": _math_functions(),
    }
    if options := _python_options():
        values["python_options"] = options
    if (zone := "/".join(dict.fromkeys(time.tzname))) != "UTC":  # of runs that are not pinned
        values["time_zone"] = zone
    values.update(_versions())
    kernels = "" if job is None else numerical_libraries(job)
    if kernels:
        values["numerics"] = kernels
    return values
