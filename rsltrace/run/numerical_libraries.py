"""Which numerical libraries a job may depend on, and the kernel each chose for the processor.

OpenBLAS and its like round differently on different processors. A trace says which kernels they
used, but only of a job whose modules use such libraries: any other has the same bytes everywhere.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from types import CodeType, FunctionType, ModuleType

from rsltrace.guard.callers import is_own, is_user_file
from rsltrace.guard.pin import thread_pools
from rsltrace.job import Job
from rsltrace.run.process import user_modules

_LIBRARIES = frozenset(
    "numpy scipy pandas cv2 torch tensorflow jax numba sklearn casadi cvxpy filterpy pinocchio "
    "shapely skimage".split()
)


def numerical_libraries(job: Job) -> str:
    """Return the libraries with version and kernel, or an empty text if the job uses none.

    The nodes' modules are imported already. For what a run imports later see ``LateLibraries``.
    """
    return _kernels() if any(map(_uses_numbers, _modules(job))) else ""


class LateLibraries:
    """Looks at the end of a run for libraries that only it has imported.

    A main imports what it needs when it runs: a test suite its tests, for instance.
    """

    def __init__(self, programs: Iterable[CodeType]) -> None:
        self._before = set(sys.modules)
        self._programs = tuple(programs)

    def find(self) -> str:
        """Return what ``numerical_libraries`` does, of the modules that user code loaded since."""
        loaded = [sys.modules.get(name) for name in sorted(set(sys.modules) - self._before)]
        of_user = [one for one in loaded if one is not None and _is_of_user(one)]
        if any(map(_uses_numbers, of_user)) or any(map(_imports_numbers, self._programs)):
            return _kernels()
        return ""


def _kernels() -> str:
    keys = ("internal_api", "version", "architecture")
    found = {
        " ".join(str(pool[key]) for key in keys if pool.get(key))
        for pool in thread_pools().threadpool_info()
    }
    return ", ".join(sorted(found))


def _is_of_user(module: ModuleType) -> bool:
    file = getattr(module, "__file__", None)
    return isinstance(file, str) and not is_own(module.__name__) and is_user_file(file)


def _imports_numbers(code: CodeType) -> bool:
    """Whether a program, or a function in it, imports one of the libraries by name."""
    return any(name.partition(".")[0] in _LIBRARIES for name in code.co_names) or any(
        _imports_numbers(part) for part in code.co_consts if isinstance(part, CodeType)
    )


def _modules(job: Job) -> Iterable[ModuleType]:
    """Return the loaded modules that are the user's: in the search path, or a node's package."""
    names = set(user_modules([str(job.resolve(folder)) for folder in job.search_path]))
    packages = {spec.package for spec in job.nodes} - {""}
    names |= {name for name in sys.modules if name.partition(".")[0] in packages}
    return [sys.modules[name] for name in sorted(names)]


def _uses_numbers(module: ModuleType) -> bool:
    """Whether a module has something of the libraries, or a function that imports one."""
    file = getattr(module, "__file__", None)
    for value in list(vars(module).values()):
        name = value.__name__ if isinstance(value, ModuleType) else _home(value)
        if name.partition(".")[0] in _LIBRARIES:
            return True
        functions = vars(value).values() if isinstance(value, type) else (value,)
        for one in functions:
            code = one.__code__ if type(one) is FunctionType else None
            if code is not None and code.co_filename == file and _imports_numbers(code):
                return True
    return False


def _home(value: object) -> str:
    """Return the module that a function or class is from."""
    if not isinstance(value, type) and not callable(value):
        return ""
    name = getattr(value, "__module__", "")
    return name if isinstance(name, str) else ""
