"""What a build adds to the sources: its version, and the compiled module where a compiler is.

python hatch_build.py    builds the module into this checkout, if a source is newer
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ModuleNotFoundError:  # run as a program
    BuildHookInterface = object

_TEXT = '"""The version of this build."""\n\n__version__ = {version!r}\n'
_MODULE = "rsltrace/_core.abi3.so"
_FOLDER = Path(__file__).resolve().parent / "rsltrace"
_SOURCES = sorted(_FOLDER.glob("_*.c"))
_OPTIONS = (
    "-std=c11",
    "-O3",
    "-fPIC",
    "-fno-plt",
    "-shared",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
)


class BuildOfRsltrace(BuildHookInterface):  # type: ignore[misc, valid-type]
    """Replaces ``rsltrace/_version.py`` in wheels; editable installs keep the checkout's. Both get
    the compiled module, which serves every CPython from 3.10 on."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files, of a folder that lasts as long as the build."""
        if self.target_name != "wheel":
            return
        self._folder = TemporaryDirectory()
        folder = Path(self._folder.name)
        if version == "editable":
            self._say(compile_core(_FOLDER / Path(_MODULE).name))
            return
        made = folder / "_version.py"
        made.write_text(_TEXT.format(version=self.metadata.version), encoding="utf-8")
        build_data["force_include"][str(made)] = "rsltrace/_version.py"
        problem = compile_core(folder / "core.so")
        self._say(problem)
        if not problem:
            build_data["force_include"][str(folder / "core.so")] = _MODULE
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["pure_python"] = False
            build_data["tag"] = f"cp310-abi3-{platform}"

    def _say(self, problem: str) -> None:
        if problem:
            self.app.display_info(f"rsltrace without its compiled module: {problem}")

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Take the folder away."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()


def compile_core(made: Path) -> str:
    """Compile the module; return why it could not be."""
    if sys.implementation.name != "cpython" or sysconfig.get_config_var("Py_GIL_DISABLED"):
        return "it is for CPython with a GIL"
    if not sys.platform.startswith("linux"):
        return "it is for Linux"
    compiler = shlex.split(os.environ.get("CC", "")) or ["cc"]
    unfinished = made.with_name(f"{made.name}.{os.getpid()}")
    include = f"-I{sysconfig.get_path('include')}"
    command = [*compiler, *_OPTIONS, include, *map(str, _SOURCES), "-o", str(unfinished)]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            return f"{shlex.join(command)}: {done.stderr.strip()}"
        unfinished.replace(made)  # a process may have the old one loaded
    except OSError as error:
        return f"{shlex.join(command)}: {error}"
    finally:
        unfinished.unlink(missing_ok=True)
    return ""


def main() -> None:
    """Build in place what is out of date."""
    made = _FOLDER / Path(_MODULE).name
    newest = max(source.stat().st_mtime for source in _FOLDER.glob("_*.[ch]"))
    if not made.exists() or made.stat().st_mtime < newest:
        problem = compile_core(made)
        if problem:
            print(f"rsltrace without its compiled module: {problem}")


if __name__ == "__main__":
    main()
