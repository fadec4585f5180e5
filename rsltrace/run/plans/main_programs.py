"""Programs that are run, not imported: what ``python script.py`` and ``python -m module`` start.

Their code runs as ``__main__``: in the module of that name which every main has to itself, as a
process has. So ``unittest.main()``, ``pickle`` and ``dataclasses`` find what the program defines.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType

from rsltrace.adapters.rclpy.hints import cannot_import, import_raised
from rsltrace.errors import JobError
from rsltrace.guard.virtual.user_modules import code_of_script
from rsltrace.run.process import run_as_main
from rsltrace.simulation.middleware.events.failure import text_of
from rsltrace.trace.model.regular_file import read_regular


@dataclass(frozen=True)
class MainProgram:
    """Code to run as ``__main__``. ``folder`` is where Python looks for its modules first; ``spec``
    is None for a script."""

    path: Path
    code: CodeType
    folder: str
    spec: ModuleSpec | None = None

    def __call__(self) -> None:
        """Run the program in the ``__main__`` of the main that runs."""
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
    """Return a module to run as ``python -m name`` does in ``folder``; its packages are imported.

    :raises JobError: if there is no such module, or it is no Python source.
    """
    try:
        spec = run_as_main(name)
    except ModuleNotFoundError as error:
        parent = name.rpartition(".")[0]
        if not f"{parent}.".startswith(f"{error.name}."):
            raise JobError(cannot_import(parent, error), where=where) from error
        spec = None
    except (Exception, SystemExit) as error:
        raised = import_raised(name.rpartition(".")[0], error, text_of(error))
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


__all__ = ["MainProgram", "module_program", "script_program"]
