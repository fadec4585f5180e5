"""Which numerical libraries a job may depend on, and the kernel each chose for the processor.

OpenBLAS and its like round differently on different processors. A trace says which kernels they
used, but only of a job whose modules use such libraries: any other has the same bytes everywhere.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from types import ModuleType

from rsltrace.job import Job
from rsltrace.run.process import user_modules

_LIBRARIES = frozenset(
    "numpy scipy pandas cv2 torch tensorflow jax numba sklearn casadi cvxpy filterpy pinocchio "
    "shapely skimage".split()
)


def numerical_libraries(job: Job) -> str:
    """Return the libraries with version and kernel, or an empty text if the job uses none.

    The nodes' modules are imported already. What a function imports later is not seen.
    """
    if not any(_uses_numbers(module) for module in _modules(job)):
        return ""
    from threadpoolctl import threadpool_info

    keys = ("internal_api", "version", "architecture")
    found = {
        " ".join(str(pool[key]) for key in keys if pool.get(key)) for pool in threadpool_info()
    }
    return ", ".join(sorted(found))


def _modules(job: Job) -> Iterable[ModuleType]:
    """Return the loaded modules that are the user's: in the search path, or a node's package."""
    names = set(user_modules([str(job.resolve(folder)) for folder in job.search_path]))
    packages = {spec.package for spec in job.nodes} - {""}
    names |= {name for name in sys.modules if name.partition(".")[0] in packages}
    return [sys.modules[name] for name in sorted(names)]


def _uses_numbers(module: ModuleType) -> bool:
    for value in list(vars(module).values()):
        name = value.__name__ if isinstance(value, ModuleType) else _home(value)
        if name.partition(".")[0] in _LIBRARIES:
            return True
    return False


def _home(value: object) -> str:
    """Return the module that a function or class is from."""
    if not isinstance(value, type) and not callable(value):
        return ""
    name = getattr(value, "__module__", "")
    return name if isinstance(name, str) else ""
