"""Makes Python classes of the interfaces of a package that nobody has built, with ROS's rosidl.

They have what rosidl's own have but the compiled type support, which a simulation never calls: its
codecs are made of the classes. They are kept in a cache, under the content of the files.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr, suppress
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rsltrace.errors import JobError, SetupError
from rsltrace.source_packages import SourcePackage
from rsltrace.terminal import tell
from rsltrace.workspace.cache import cached_folder, key_of

_MADE_BY = "1"
"""Changes when what is made of the same files does."""
_NEEDED = (
    *("rosidl_adapter", "rosidl_generator_py", "rosidl_generator_type_description"),
    *("rosidl_parser", "rosidl_pycommon", "em", "lark"),
)
_TYPE = re.compile(r"^[ \t]*([a-z][a-z0-9_]*)/(?:msg/)?[A-Z]\w*", re.MULTILINE)
_RUN = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); "
    "from rsltrace.workspace.generate import main; sys.exit(main())"
)


def interface_prefix(
    package: SourcePackage, others: Mapping[str, SourcePackage], on_way: tuple[str, ...] = ()
) -> Path:
    """Return a prefix with the classes (``site-packages``) and definitions (``share``).

    ``others`` are the packages whose interfaces those of this one may use, besides what is built.

    :raises JobError: if an interface file cannot be understood, or needs one that is not there.
    :raises SetupError: if rosidl is not there.
    """
    files = _by_folder(package)
    content = [(package.folder / folder / file).read_bytes() for folder, file in files]
    shares: dict[str, str] = {}
    keys = []
    for (folder, file), data in zip(files, content, strict=True):
        for name in sorted(set(_TYPE.findall(data.decode("utf-8", "replace"))) - {package.name}):
            if name not in shares:
                used = _share_of(name, others, (*on_way, package.name))
                if used is None:
                    raise JobError(
                        f"it uses types of the package {name!r}, which is neither installed nor in "
                        "search_path: install it, or add the folder of its sources there",
                        where=str(package.folder / folder / file),
                    )
                shares[name] = str(used)
                keys.append(str(used))
    shares |= _shares_of_ros()
    names = [str(file) for _, file in files]
    key = key_of([_MADE_BY, _versions(), package.name, *names, *content, *sorted(keys)])
    order = {
        "package": package.name,
        "files": [(str(package.folder / folder), str(file)) for folder, file in files],
        "shares": shares,
    }
    return cached_folder("interfaces", f"{package.name}-{key}", lambda into: _make(order, into))


def _by_folder(package: SourcePackage) -> list[tuple[Path, Path]]:
    """Return each interface file as rosidl wants it: a folder, and ``msg/Name.msg`` in it."""
    return [(file.parent.parent, Path(file.parent.name, file.name)) for file in package.interfaces]


def _share_of(
    name: str, others: Mapping[str, SourcePackage], on_way: tuple[str, ...]
) -> Path | None:
    """Return where the definitions of a package are: made here, or installed."""
    installed = _installed_share(name)
    other = others.get(name)
    if installed is not None or other is None or not other.interfaces:
        return installed
    if name in on_way:
        raise JobError(
            f"its interfaces and those of {on_way[-1]!r} need each other",
            where=str(other.folder / "package.xml"),
        )
    return interface_prefix(other, others, on_way) / "share" / name


def _installed_share(name: str) -> Path | None:
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    for prefix in filter(None, prefixes):
        share = Path(prefix) / "share" / name
        if share.is_dir():
            return share
    return None


def _shares_of_ros() -> dict[str, str]:
    """Return the packages whose types every service and action uses."""
    names = ("service_msgs", "action_msgs", "unique_identifier_msgs", "builtin_interfaces")
    found = {name: _installed_share(name) for name in names}
    return {name: str(share) for name, share in found.items() if share is not None}


def _versions() -> str:
    """Return what the classes depend on besides the files."""
    found = []
    for name in _NEEDED[:5]:
        try:
            found.append(metadata.version(name))
        except metadata.PackageNotFoundError:
            found.append("")
    return " ".join(found)


def _make(order: Mapping[str, Any], into: Path) -> None:
    missing = [name for name in _NEEDED if find_spec(name) is None]
    templates = _templates()
    if missing or templates is None:
        raise SetupError(
            f"the interfaces of {order['package']} are not built, and making classes of them needs "
            f"ROS's rosidl ({', '.join(missing) or 'rosidl_generator_py'} cannot be found): "
            "pip install ros-jazzy-common-interfaces, or source a ROS 2 that has rosidl"
        )
    _say_what_takes_long(order)
    done = subprocess.run(
        [sys.executable, "-c", _RUN, json.dumps(sys.path)],
        input=json.dumps({**order, "into": str(into), "templates": str(templates)}),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise _failure(order, done.stderr)


def _say_what_takes_long(order: Mapping[str, Any]) -> None:
    """Say what is being made, past what a node may have put in the place of ``sys.stderr``."""
    with suppress(OSError, ValueError), redirect_stderr(sys.__stderr__):
        tell(
            f"rsltrace: note: making Python classes of the interfaces of {order['package']} "
            f"(interface files: {len(order['files'])}), which takes a while, once"
        )


def _failure(order: Mapping[str, object], said: str) -> JobError | SetupError:
    last = (said.strip().splitlines() or [""])[-1]
    try:
        told = json.loads(last)
        return JobError(f"rosidl cannot read it: {told['error']}", where=told["place"])
    except (ValueError, KeyError, TypeError):
        return SetupError(f"rosidl failed over the interfaces of {order['package']}: {last}")


def _templates() -> Path | None:
    share = _installed_share("rosidl_generator_py")
    folder = None if share is None else share / "resource"
    return folder if folder is not None and (folder / "_idl.py.em").is_file() else None


__all__ = ["interface_prefix"]
