"""Programs on rcl's C API, compiled against the ROS that is here; without a compiler they are
skipped, and say so."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes.build import find_compiler, find_ros
from rsltrace.errors import SetupError

SOURCES = Path(__file__).parent
_LIBRARIES = (
    "rcl",
    "rcutils",
    "rcl_yaml_param_parser",
    "tracetools",
    "rosidl_runtime_c",
    "rosidl_typesupport_c",
    "std_msgs__rosidl_typesupport_c",
    "std_msgs__rosidl_generator_c",
    "std_srvs__rosidl_typesupport_c",
    "std_srvs__rosidl_generator_c",
    "rosgraph_msgs__rosidl_typesupport_c",
    "rosgraph_msgs__rosidl_generator_c",
)


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Compile a C program of this folder, once."""
    try:
        ros, compiler = find_ros(), find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("programs")

    def compile(name: str) -> Path:
        target = folder / Path(name).stem
        if not target.exists():
            include = [f"-I{path}" for path in ros.include]
            link = [f"-l{library}" for library in _LIBRARIES]
            words = ["-Wall", "-Wextra", "-Werror", "-O1", "-g", "-x", "c", str(SOURCES / name)]
            words += ["-x", "none", "-o", str(target), *include, f"-L{ros.prefix / 'lib'}", *link]
            words.append("-Wl,--unresolved-symbols=ignore-in-shared-libs")
            subprocess.run([*compiler, *words], check=True)
        return target

    return compile
