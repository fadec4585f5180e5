"""Makes Python classes of the interfaces of a package that nobody has built, with ROS's rosidl.

They have what rosidl's own have but the compiled type support, which a simulation never calls: its
codecs are made of the classes. Each is made when it is imported for the first time, with what it
uses, and kept in a cache, under the content of the package's files.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from functools import cached_property
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rsltrace.adapters.workspace.bundled import BUNDLED, is_bundled
from rsltrace.adapters.workspace.cache import cached_folder, key_of
from rsltrace.adapters.workspace.generate import READY
from rsltrace.errors import JobError, SetupError
from rsltrace.job.reading.substitute import package_prefix
from rsltrace.source_packages import SourcePackage
from rsltrace.terminal import tell

_MADE_BY = "2"
"""Changes when what is made of the same files does."""
_NEEDED = (
    *("rosidl_adapter", "rosidl_generator_py", "rosidl_generator_type_description"),
    *("rosidl_parser", "rosidl_pycommon", "em", "lark"),
)
_PACKAGE = re.compile(r"^[ \t]*([a-z][a-z0-9_]*)/(?:msg/)?[A-Z]\w*", re.MULTILINE)
_OF_ROS_1 = {
    "time": "builtin_interfaces/Time",
    "duration": "builtin_interfaces/Duration",
    "Header": "std_msgs/Header",
}
_FIELD = re.compile(
    r"[ \t]*(?:(?P<package>[a-z][a-z0-9_]*)/(?:msg/)?)?(?P<name>[A-Z]\w*|time|duration)"
    r"(?:\[[^\]]*\])?[ \t]+[A-Za-z]\w*"
)
_USED_BY_ALL = ("service_msgs", "action_msgs", "unique_identifier_msgs", "builtin_interfaces")
"""The packages whose types every service and action uses."""
_NAMED_MAX = 5
_TOLD_EVERY_S = 5.0
_SERVICE = ("", "_Event", "_Request", "_Response")
_ACTION = ("", *(f"_{part}{end}" for part in ("GetResult", "SendGoal") for end in _SERVICE[1:]))
EXPORTS = {"msg": ("",), "srv": _SERVICE, "action": _ACTION}
"""What the package of a kind offers of each interface, as rosidl has it."""

_WHEN_IMPORTED = '''\
"""The interfaces of a package that nobody has built: their classes are made when imported."""

from rsltrace.adapters.workspace.imports import made_when_imported

__getattr__, __all__ = made_when_imported(__name__)


def __dir__():
    return __all__
'''
_NOT_COMPILED = '''\
"""Stands in for the compiled type support, which nothing in a simulation calls."""


class _NotCompiled:
    def __init__(self, name):
        self.name = name

    def __call__(self, *arguments):
        raise RuntimeError(f"{self.name}: the interfaces of this package have not been built")


def __getattr__(name):
    if name.startswith("_"):
        raise AttributeError(name)
    return _NotCompiled(name)
'''
_RUN = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); "
    "from rsltrace.adapters.workspace.generate import main; sys.exit(main())"
)


def interface_makers(packages: Mapping[str, SourcePackage]) -> dict[str, InterfaceMaker]:
    """Return what makes the classes of the packages that have interfaces, by name."""
    makers: dict[str, InterfaceMaker] = {}
    for name, package in packages.items():
        if package.interfaces:
            makers[name] = InterfaceMaker(package, makers)
    return makers


class InterfaceMaker:
    """Makes the classes of the interfaces of ``package``; ``makers`` has those of the packages
    whose interfaces they may use, besides what is built."""

    def __init__(self, package: SourcePackage, makers: Mapping[str, InterfaceMaker]) -> None:
        self._package = package
        self._makers = makers

    @cached_property
    def prefix(self) -> Path:
        """A prefix with the classes (``site-packages``) and definitions (``share``) made so far."""
        name = f"{self._package.name}-{self._key(())}"
        return cached_folder("interfaces", name, self._lay_out)

    def _key(self, on_way: tuple[str, ...]) -> str:
        """Return a name for the content of the package's files, and of what they may use."""
        name = self._package.name
        content = [(self._package.folder / file).read_bytes() for file in self._package.interfaces]
        used = set[str]()
        for other in {
            one for data in content for one in _PACKAGE.findall(data.decode("utf-8", "replace"))
        }:
            share, maker = _installed_share(other), self._makers.get(other)
            if share is not None:
                used.add(str(share))
            elif maker is not None and other not in (*on_way, name):
                used.add(maker._key((*on_way, name)))
        files = [str(file) for file in self._package.interfaces]
        return key_of([_MADE_BY, _versions(), name, *files, *content, *sorted(used)])

    @property
    def modules(self) -> Path:
        """The folder of the package with the classes."""
        return self.prefix / "site-packages" / self._package.name

    def names(self, kind: str) -> dict[str, str]:
        """Return what ``package.kind`` offers, each with the interface that it belongs to."""
        stems = [file.stem for file in self._package.interfaces if file.suffix == f".{kind}"]
        return {f"{stem}{end}": stem for stem in stems for end in EXPORTS[kind]}

    def module_of(self, kind: str, stem: str) -> Path:
        """Return the file with the class of an interface, whether it is made or not."""
        return self.modules / kind / f"_{module_name(stem)}.py"

    def make(self, kind: str, *stems: str) -> None:
        """Make the classes of interfaces, and of those that they use, unless they are there.

        :raises JobError: if its file cannot be understood, or uses what is not there.
        :raises SetupError: if rosidl is not there.
        """
        needed: dict[tuple[str, Path], InterfaceMaker] = {}
        for file in self._package.interfaces:
            if file.suffix == f".{kind}" and file.stem in stems:
                self._collect(file, needed, ())
        if needed:
            names = [stem for stem in stems if any(file.stem == stem for _, file in needed)]
            more = f" and {len(names) - _NAMED_MAX} more" if len(names) > _NAMED_MAX else ""
            name = f"{self._package.name}/{kind}/{', '.join(names[:_NAMED_MAX])}{more}"
            bundled = {m._package.name for m in needed.values() if is_bundled(m._package)}
            _generate(name, _order(needed), uses=len(needed) - len(names), bundled=sorted(bundled))

    def _collect(
        self,
        file: Path,
        needed: dict[tuple[str, Path], InterfaceMaker],
        on_way: tuple[tuple[str, Path], ...],
    ) -> None:
        """Put an interface into ``needed``, after those that it uses."""
        own = (self._package.name, file)
        if own in needed or self.module_of(file.suffix[1:], file.stem).is_file():
            return
        path = self._package.folder / file
        for line, package, name in used_types(path.read_text("utf-8", "replace")):
            where = f"{path}:{line}"
            maker = self._maker_of(package or self._package.name, where)
            if maker is None:
                share = _installed_share(package)
                if share is not None and not any((share / "msg").glob(f"{name}.*")):
                    raise JobError(_no_such_type(package, package, name), where=where)
                continue
            found = next(
                (f for f in maker._package.interfaces if (f.suffix, f.stem) == (".msg", name)), None
            )
            if found is None:
                raise JobError(_no_such_type(maker._package.name, package, name), where=where)
            if (maker._package.name, found) in (*on_way, own):
                raise JobError(f"it and {maker._package.name}/{name} need each other", where=where)
            maker._collect(found, needed, (*on_way, own))
        needed[own] = self

    def _maker_of(self, package: str, where: str) -> InterfaceMaker | None:
        """Return what makes the interfaces of a package, None if they are installed."""
        if package == self._package.name:
            return self
        if _installed_share(package) is not None:
            return None
        maker = self._makers.get(package)
        if maker is None:
            raise JobError(
                f"it uses types of the package {package!r}, which is neither installed nor in "
                "search_path: install it, or add the folder of its sources there",
                where=where,
            )
        return maker

    def _lay_out(self, into: Path) -> None:
        """Write the modules that rosidl's generator would, but for those that need a compiler, and
        for the classes, which are made when they are imported."""
        name = self._package.name
        site = into / "site-packages" / name
        site.mkdir(parents=True)
        (into / "share" / name).mkdir(parents=True)
        (site / "__init__.py").touch()
        (site / f"{name}_s__rosidl_typesupport_c.py").write_text(_NOT_COMPILED)
        for kind in sorted({file.suffix[1:] for file in self._package.interfaces}):
            (site / kind).mkdir()
            (site / kind / "__init__.py").write_text(_WHEN_IMPORTED)


def _order(needed: Mapping[tuple[str, Path], InterfaceMaker]) -> dict[str, Any]:
    """Return what ``generate`` is to make, in this order, and where the definitions are that it may
    use: installed, or made."""
    shares = {}
    interfaces = []
    for (name, file), maker in needed.items():
        path = maker._package.folder / file
        shares[name] = maker.prefix / "share" / name
        place = {"package": name, "path": str(path), "file": f"{file.suffix[1:]}/{file.name}"}
        interfaces.append({**place, "into": str(maker.prefix)})
        text = path.read_text("utf-8", "replace")
        for other in {*_USED_BY_ALL, *_PACKAGE.findall(text)}:
            share, others_maker = _installed_share(other), maker._makers.get(other)
            if share is not None:
                shares.setdefault(other, share)
            elif others_maker is not None:
                shares.setdefault(other, others_maker.prefix / "share" / other)
    return {"interfaces": interfaces, "shares": {name: str(one) for name, one in shares.items()}}


def used_types(text: str) -> Iterator[tuple[int, str, str]]:
    """Give line, package ("" for its own) and name of the types that an interface file uses.

    A type of ROS 1 is one of the package "", under the name that it has there.
    """
    for number, line in enumerate(text.splitlines(), 1):
        found = _FIELD.match(line)
        if found is not None:
            yield number, found["package"] or "", found["name"]


def module_name(stem: str) -> str:
    """Return what rosidl calls the module of an interface: ``JointState`` is ``joint_state``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=.)(?=[A-Z][a-z])", "_", stem).lower()


def _no_such_type(package: str, written: str, name: str) -> str:
    if not written and name in _OF_ROS_1:
        return f"{name!r} is a type of ROS 1: write {_OF_ROS_1[name]}"
    return f"there is no {name}.msg in the package {package!r}" + (
        "" if written else ": write package/Name for a type of another package"
    )


def _installed_share(name: str) -> Path | None:
    prefix = package_prefix(name)
    return None if prefix is None else prefix / "share" / name


def _versions() -> str:
    """Return what the classes depend on besides the files."""
    found = []
    for name in _NEEDED[:5]:
        try:
            found.append(metadata.version(name))
        except metadata.PackageNotFoundError:
            found.append("")
    return " ".join(found)


def _missing() -> list[str]:
    return [module for module in _NEEDED if find_spec(module) is None]


def has_rosidl() -> bool:
    """Return whether classes can be made of interface files."""
    return not _missing() and _templates() is not None


def _generate(name: str, order: dict[str, Any], *, uses: int, bundled: Sequence[str] = ()) -> None:
    """Have rosidl make what the order says, in a process of its own; what is ready is kept.

    ``name`` is what somebody wants, ``uses`` how many interfaces more that takes, ``bundled`` the
    packages whose definitions are rsltrace's own.
    """
    missing, templates = _missing(), _templates()
    if missing or templates is None:
        raise SetupError(
            f"{name} is not built, and making a class of it needs "
            f"ROS's rosidl ({', '.join(missing) or 'rosidl_generator_py'} cannot be found): "
            "pip install ros-jazzy-common-interfaces, or source a ROS 2 that has rosidl"
        )
    more = f", and of what that uses (interface files: {uses})" if uses else ""
    own = ", ".join(f"{package} {BUNDLED[package]}" for package in bundled)
    source = f"; from rsltrace's own definitions of ROS 2 Jazzy: {own}" if own else ""
    _tell(f"making Python classes of {name}{more}, once{source}")
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as given:
        json.dump({**order, "templates": str(templates)}, given)
        given.seek(0)
        command = [sys.executable, "-c", _RUN, json.dumps(sys.path)]
        pipes: Any = {"stdin": given, "stdout": subprocess.PIPE, "stderr": said}
        with subprocess.Popen(command, text=True, **pipes) as process:
            try:
                _tell_progress(process.stdout or (), name, len(order["interfaces"]))
            except BaseException:
                process.kill()
                raise
        if process.returncode:
            said.seek(0)
            raise _failure(name, said.read())


def _tell_progress(lines: Iterable[str], name: str, count: int) -> None:
    """Say now and then how much is ready."""
    ready, told_s = 0, time.monotonic()
    for line in lines:
        ready += line == READY
        if line == READY and time.monotonic() - told_s >= _TOLD_EVERY_S:
            told_s = time.monotonic()
            _tell(f"{ready} of {count} interface files are ready for {name}")


def _tell(text: str) -> None:
    """Say something past what a node may have put in the place of ``sys.stderr``."""
    with suppress(OSError, ValueError), redirect_stderr(sys.__stderr__):
        tell(f"rsltrace: note: {text}")


def _failure(name: str, said: str) -> JobError | SetupError:
    last = (said.strip().splitlines() or [""])[-1]
    try:
        answer = json.loads(last)
        return JobError(f"rosidl cannot read it: {answer['error']}", where=answer["place"])
    except (ValueError, KeyError, TypeError):
        return SetupError(f"rosidl failed over {name}: {last}")


def _templates() -> Path | None:
    share = _installed_share("rosidl_generator_py")
    folder = None if share is None else share / "resource"
    return folder if folder is not None and (folder / "_idl.py.em").is_file() else None
