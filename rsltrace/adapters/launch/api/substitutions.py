"""``launch.substitutions`` and ``launch_ros.substitutions``."""

from __future__ import annotations

import importlib
import math
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

from rsltrace.adapters.launch.api.basics import (
    NOWHERE,
    WHY,
    LaunchContext,
    Substitution,
    SubstitutionFailure,
    as_substitutions,
    calling_line,
)
from rsltrace.adapters.launch.model import equal_texts, truth
from rsltrace.errors import did_you_mean
from rsltrace.job.reading.substitute import package_prefix
from rsltrace.trace.model.regular_file import read_regular

# Where packages lie; those that are not there have a folder that is not, either. A launch file
# asks for the shares of packages whose nodes cannot be simulated anyway (Gazebo, Nav2): what it
# wants of them is left out, and the rest of it goes on.

_ASKED = ("get_package_share_directory", "get_package_share_path", "get_package_prefix")


def names_missing_package(value: object) -> str | None:
    """Return a package that is not there, if a text (or one in a list) names a path in it."""
    for item in value if isinstance(value, (list, tuple)) else (value,):
        if isinstance(item, str) and f"{NOWHERE}/share/" in item:
            return item.partition(f"{NOWHERE}/share/")[2].partition("/")[0]
    return None


def prefix_of(package: str) -> str:
    """Return the prefix of a package; ``get_package_prefix`` of this process is asked."""
    try:
        from ament_index_python.packages import get_package_prefix
    except ImportError:
        prefix = package_prefix(package)
        return NOWHERE if prefix is None else str(prefix)
    return str(get_package_prefix(package))


def share_of(package: str) -> str:
    return os.path.join(prefix_of(package), "share", package)


@contextmanager
def missing_packages_allowed(context: LaunchContext) -> Iterator[None]:
    """Give packages that are not there a folder, and note them as left out.

    A launch file that catches ``PackageNotFoundError`` itself gets it.
    """
    if find_spec("ament_index_python") is None:
        yield
        return
    from ament_index_python import packages

    noted: set[str] = set()
    real = packages.get_package_prefix

    def get_package_prefix(package_name: str) -> Any:
        try:
            return real(package_name)
        except packages.PackageNotFoundError:
            if _is_caught_by_caller():
                raise
            if package_name not in noted:
                noted.add(package_name)
                context.launched.ignored.append(
                    f"{context.where or calling_line()}: there is no package {package_name!r}: "
                    f"{WHY}; what wants something of it is left out"
                )
            return NOWHERE

    def get_package_share_directory(package_name: str, print_warning: bool = True) -> str:
        return os.path.join(get_package_prefix(package_name), "share", package_name)

    def get_package_share_path(package_name: str, print_warning: bool = True) -> Path:
        return Path(get_package_share_directory(package_name))

    ours = (get_package_share_directory, get_package_share_path, get_package_prefix)
    with ExitStack() as stack:
        for name, function in zip(_ASKED, ours, strict=True):
            for key, module in list(sys.modules.items()):
                if key.startswith("ament_index_python") and hasattr(module, name):
                    stack.callback(setattr, module, name, getattr(module, name))
                    setattr(module, name, function)
        yield


def _is_caught_by_caller() -> bool:
    """Whether the launch file that asks knows the error: it may do something else then."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if "PackageNotFoundError" in frame.f_globals and not frame.f_globals.get(
            "__name__", ""
        ).startswith(("ament_index_python", "rsltrace.")):
            return True
        frame = frame.f_back
    return False


def _word(value: bool) -> str:
    return str(value).lower()


def _operand(given: Any) -> Any:
    """Return what a comparison compares as text or substitutions."""
    if given is None:
        return ""
    if isinstance(given, bool):
        return _word(given)
    return str(given) if isinstance(given, (int, float)) else given


class LaunchConfiguration(Substitution):
    """The value of a launch argument."""

    def __init__(self, variable_name: Any, *, default: Any = None) -> None:
        self.variable_name = as_substitutions(variable_name)
        self._default = None if default is None else _default(default)

    def describe(self) -> str:
        return f"$(var {''.join(part.describe() for part in self.variable_name)})"

    def perform(self, context: LaunchContext) -> str:
        name = context.text(self.variable_name)
        value = context.launch_configurations.get(name)
        if value is not None:
            return value
        if self._default is None:
            names = sorted(context.launch_configurations)
            there = f"there are {', '.join(names)}" if names else "none is declared"
            hint = did_you_mean(name, names, there)
            raise SubstitutionFailure(f"there is no launch argument {name!r}; {hint}")
        return context.text(self._default)


def _default(given: Any) -> Any:
    """Return a default as text or substitutions: it may also be a number, or some of them."""
    if isinstance(given, (str, Substitution, os.PathLike)):
        return given
    if isinstance(given, Iterable):
        return [part if isinstance(part, (str, Substitution)) else str(part) for part in given]
    return str(given)


class EnvironmentVariable(Substitution):
    """The value of an environment variable, as the launch file has it."""

    def __init__(self, name: Any, *, default_value: Any = None) -> None:
        self.name = as_substitutions(name)
        self._default = default_value

    def describe(self) -> str:
        return f"$(env {''.join(part.describe() for part in self.name)})"

    def perform(self, context: LaunchContext) -> str:
        name = context.text(self.name)
        value = context.environment.get(name)
        if value is not None:
            return value
        if self._default is None:
            raise SubstitutionFailure(
                f"the environment variable {name} is not set: set it, or give a default"
            )
        return context.text(self._default)


class PathJoinSubstitution(Substitution):
    """A path of parts."""

    def __init__(self, substitutions: Iterable[Any]) -> None:
        self.substitutions = [as_substitutions(part) for part in substitutions]

    def describe(self) -> str:
        return "/".join("".join(p.describe() for p in part) for part in self.substitutions)

    def perform(self, context: LaunchContext) -> str:
        return os.path.join(*(context.text(part) for part in self.substitutions))

    def __truediv__(self, other: Any) -> PathJoinSubstitution:
        return PathJoinSubstitution([*self.substitutions, other])


class PathSubstitution(PathJoinSubstitution):
    """A path that ``/`` makes longer."""

    def __init__(self, path: Any) -> None:
        super().__init__([path])


class StringJoinSubstitution(Substitution):
    """Texts with a delimiter between them."""

    def __init__(self, substitutions: Iterable[Any], delimiter: Any = "") -> None:
        self.substitutions = [as_substitutions(part) for part in substitutions]
        self.delimiter = as_substitutions(delimiter)

    def perform(self, context: LaunchContext) -> str:
        return context.text(self.delimiter).join(map(context.text, self.substitutions))


class PythonExpression(Substitution):
    """The value of a Python expression."""

    def __init__(self, expression: Any, python_modules: Any = ("math",)) -> None:
        self.expression = as_substitutions(expression)
        self.python_modules = as_substitutions(python_modules)

    def perform(self, context: LaunchContext) -> str:
        """Return the value as text; a launch file is a program, so this runs as it is."""
        text = context.text(self.expression)
        seen: dict[str, Any] = {}
        for part in self.python_modules:
            module = importlib.import_module(part.perform(context))
            if module is math:
                seen.update(vars(math))
            seen[module.__name__] = module
        try:
            return str(eval(text, {}, seen))
        except Exception as error:
            raise SubstitutionFailure(
                f"PythonExpression {text!r} raises {type(error).__name__}: {error}"
            ) from error


class Command(Substitution):
    """What a command prints."""

    def __init__(self, command: Any, *, on_stderr: Any = "fail") -> None:
        self.command = as_substitutions(command)
        self.on_stderr = as_substitutions(on_stderr)

    def perform(self, context: LaunchContext) -> str:
        text = context.text(self.command)
        words = shlex.split(text)
        if not words:
            raise SubstitutionFailure("Command: there is no command")
        program = find_program(words[0])
        if program is None:
            hint = ": pip install xacro" if os.path.basename(words[0]) == "xacro" else ""
            raise SubstitutionFailure(f"Command: there is no program {words[0]!r} in PATH{hint}")
        on_stderr = context.text(self.on_stderr)
        merged = subprocess.STDOUT if on_stderr == "capture" else subprocess.PIPE
        done = subprocess.run(
            [program, *words[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=merged,
            text=True,
            check=False,
        )
        said = (done.stderr or "").strip()
        if done.returncode or (said and on_stderr == "fail"):
            what = f"exit status {done.returncode}" if done.returncode else "it wrote to stderr"
            raise SubstitutionFailure(f"Command {text!r}: {what}{': ' + said if said else ''}")
        return done.stdout


def find_program(name: str) -> str | None:
    """Return the path of a program in PATH, or next to this Python."""
    return shutil.which(name) or shutil.which(name, path=os.path.dirname(sys.executable))


class FindExecutable(Substitution):
    """The path of a program."""

    def __init__(self, *, name: Any) -> None:
        self.name = as_substitutions(name)

    def perform(self, context: LaunchContext) -> str:
        name = context.text(self.name)
        path = find_program(name)
        if path is None:
            hint = ": pip install xacro" if name == "xacro" else ""
            raise SubstitutionFailure(f"executable '{name}' not found on the PATH{hint}")
        return os.path.abspath(path)


class FileContent(Substitution):
    """What is in a file."""

    def __init__(self, path: Any) -> None:
        self.path = as_substitutions(path)

    def perform(self, context: LaunchContext) -> str:
        path = context.text(self.path)
        try:
            return read_regular(Path(path)).decode()
        except OSError as error:
            raise SubstitutionFailure(f"cannot read {path}: {error.strerror}") from error


class ThisLaunchFile(Substitution):
    """The path of the launch file being read."""

    def perform(self, context: LaunchContext) -> str:
        return str(context.file)


class ThisLaunchFileDir(Substitution):
    """The folder of the launch file being read."""

    def perform(self, context: LaunchContext) -> str:
        return str(context.file.parent)

    def __truediv__(self, other: Any) -> PathJoinSubstitution:
        return PathJoinSubstitution([self, other])


class AnonName(Substitution):
    """A name that no other node has."""

    def __init__(self, name: Any) -> None:
        self.name = as_substitutions(name)

    def perform(self, context: LaunchContext) -> str:
        """Return the name and a number: ROS draws one at random, and runs must not differ."""
        return context.anonymous(context.text(self.name))


class EqualsSubstitution(Substitution):
    """``true`` if two texts, numbers or truth values are equal."""

    def __init__(self, left: Any, right: Any) -> None:
        self.left, self.right = as_substitutions(_operand(left)), as_substitutions(_operand(right))

    def perform(self, context: LaunchContext) -> str:
        return _word(equal_texts(context.text(self.left), context.text(self.right)))


class NotEqualsSubstitution(EqualsSubstitution):
    """``true`` if two texts are not equal."""

    def perform(self, context: LaunchContext) -> str:
        return _word(not equal_texts(context.text(self.left), context.text(self.right)))


class NotSubstitution(Substitution):
    """``true`` for ``false``."""

    def __init__(self, value: Any) -> None:
        self.value = as_substitutions(value)

    def perform(self, context: LaunchContext) -> str:
        return _word(not truth(context.text(self.value)))


class AllSubstitution(Substitution):
    """``true`` if all values are."""

    def __init__(self, *values: Any) -> None:
        self.values = [as_substitutions(value) for value in values]

    def perform(self, context: LaunchContext) -> str:
        return _word(all(truth(context.text(value)) for value in self.values))


class AnySubstitution(AllSubstitution):
    """``true`` if one of the values is."""

    def perform(self, context: LaunchContext) -> str:
        return _word(any(truth(context.text(value)) for value in self.values))


class AndSubstitution(AllSubstitution):
    """``true`` if both values are."""

    def __init__(self, left: Any, right: Any) -> None:
        super().__init__(left, right)


class OrSubstitution(AnySubstitution):
    """``true`` if one of two values is."""

    def __init__(self, left: Any, right: Any) -> None:
        super().__init__(left, right)


class IfElseSubstitution(Substitution):
    """One of two values, as a condition holds or not."""

    def __init__(self, condition: Any, if_value: Any = "", else_value: Any = "") -> None:
        self.condition = as_substitutions(condition)
        self.if_value, self.else_value = as_substitutions(if_value), as_substitutions(else_value)

    def perform(self, context: LaunchContext) -> str:
        return context.text(
            self.if_value if truth(context.text(self.condition)) else self.else_value
        )


class FindPackagePrefix(Substitution):
    """The prefix that a package is installed in."""

    def __init__(self, package: Any) -> None:
        self.package = as_substitutions(package)

    def describe(self) -> str:
        return f"$(find-pkg-prefix {''.join(part.describe() for part in self.package)})"

    def perform(self, context: LaunchContext) -> str:
        return self.find(context.text(self.package))

    def find(self, package_name: str) -> str:
        """Return the prefix of any package."""
        return prefix_of(package_name)

    def __truediv__(self, other: Any) -> PathJoinSubstitution:
        return PathJoinSubstitution([self, other])


class FindPackageShare(FindPackagePrefix):
    """The ``share`` folder of a package."""

    def describe(self) -> str:
        return f"$(find-pkg-share {''.join(part.describe() for part in self.package)})"

    def find(self, package_name: str) -> str:
        return share_of(package_name)


class ExecutableInPackage(FindExecutable):
    """The path of an executable of a package."""

    def __init__(self, executable: Any, package: Any) -> None:
        super().__init__(name=executable)
        self.package = as_substitutions(package)

    def perform(self, context: LaunchContext) -> str:
        """Return the path it has, or would have."""
        package = context.text(self.package)
        return os.path.join(prefix_of(package), "lib", package, context.text(self.name))
