"""What the build files of a package say.

``setup.py`` is asked without setuptools, in a process of its own; ``setup.cfg`` and
``pyproject.toml`` are read.
"""

from __future__ import annotations

import configparser
import importlib
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

_ASK = """
import fnmatch, json, os, sys, types
from importlib.machinery import ModuleSpec
sys.stdout = sys.stderr
said = {}
class Names(type):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Anything
class Anything(list, metaclass=Names):  # called, derived from, asked for names: as setuptools' own
    def __init__(self, *words, **named):
        pass
    def __getattr__(self, name):
        return getattr(Anything, name)
def find(where=".", exclude=(), include=("*",), inits=True):
    def matches(name, patterns):
        return any(fnmatch.fnmatchcase(name, one) for one in patterns)
    found = []
    for folder, folders, files in os.walk(where):
        folders[:] = sorted(one for one in folders if one.isidentifier())
        if folder == where:
            continue
        if inits and "__init__.py" not in files:
            folders.clear()
            continue
        name = os.path.relpath(folder, where).replace(os.sep, ".")
        if matches(name, include) and not matches(name, exclude):
            found.append(name)
    return found
def find_namespaces(where=".", exclude=(), include=("*",)):
    return find(where, exclude, include, inits=False)
known = {"find_packages": find, "find_namespace_packages": find_namespaces}
class Modules:
    def find_spec(self, name, path=None, target=None):
        ours = name.partition(".")[0] in ("setuptools", "distutils")
        return ModuleSpec(name, self, is_package=True) if ours else None
    def create_module(self, spec):
        return types.ModuleType(spec.name)
    def exec_module(self, module):
        module.__getattr__ = lambda name: known.get(name) or getattr(Anything, name)
        module.setup = lambda *words, **named: said.update(named)
sys.meta_path.insert(0, Modules())
code = compile(open("setup.py", "rb").read(), "setup.py", "exec")
sys.path.insert(0, "")
sys.argv[:] = ["setup.py"]
exec(code, {"__name__": "__main__", "__file__": "setup.py"})
wanted = "name version data_files entry_points scripts packages package_dir py_modules".split()
sys.stdout.flush()
json.dump({name: said[name] for name in wanted if said.get(name)}, sys.__stdout__, default=str)
"""
"""Finds out what a ``setup.py`` tells setuptools, without setuptools."""
_ASK_SECONDS = 60
_ENTRY_POINTS = "options.entry_points"

Groups = dict[str, dict[str, str]]
"""Entry points: what each name stands for, by group."""


def setup_py(folder: Path) -> dict[str, Any]:
    """Return what a ``setup.py`` gives setuptools; nothing if it cannot be run without it."""
    return _asked(folder)[0]


def setup_fault(folder: Path) -> str:
    """Return how a ``setup.py`` failed when it was asked; an empty text if it did not."""
    return _asked(folder)[1]


@cache
def _asked(folder: Path) -> tuple[dict[str, Any], str]:
    if not (folder / "setup.py").is_file():
        return {}, ""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _ASK],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_ASK_SECONDS,
            check=False,
        )
        said = json.loads(done.stdout or "{}")
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        return {}, str(error)  # what lies in its folder is there all the same
    lines = done.stderr.strip().splitlines() if done.returncode else []
    return said if isinstance(said, dict) else {}, lines[-1] if lines else ""


def setup_cfg(folder: Path) -> configparser.ConfigParser:
    """Return ``setup.cfg``; empty if there is none, or nothing that can be read."""
    return _configured(folder / "setup.cfg")


def _configured(file: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(delimiters=("=",), interpolation=None, strict=False)
    try:
        parser.read(file, encoding="utf-8")
    except (configparser.Error, UnicodeDecodeError):
        return configparser.ConfigParser()
    return parser


def _pyproject(folder: Path) -> Mapping[str, Any]:
    """Return ``pyproject.toml``; empty if there is none, or nothing that can be read."""
    toml = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    try:
        found: Mapping[str, Any] = toml.loads((folder / "pyproject.toml").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found


def _table(found: object, *names: str) -> Mapping[str, Any]:
    """Return the table below these names; an empty one if it is not there."""
    for name in names:
        found = found.get(name) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def name_and_version(folder: Path) -> tuple[str | None, str | None]:
    """Return what a package calls itself, and its version, as far as its build files say so."""
    setup, listed = setup_py(folder), setup_cfg(folder)
    pyproject = _pyproject(folder)
    project = {**_table(pyproject, "tool", "poetry"), **_table(pyproject, "project")}

    def said(key: str) -> str | None:
        given = listed.get("metadata", key, fallback=None)
        if given is not None and given.startswith(("file:", "attr:")):
            given = None
        found = setup.get(key) or given or project.get(key)
        return found.strip() if isinstance(found, str) else None

    return said("name"), said("version")


def package_dir(folder: Path) -> dict[str, str]:
    """Return where the modules of packages lie, by name; "" is for all others."""
    listed = setup_cfg(folder).get("options", "package_dir", fallback="")
    table = _table(_pyproject(folder), "tool", "setuptools", "package-dir")
    setup = setup_py(folder).get("package_dir")
    return {**text_mapping(table), **_targets(listed.splitlines()), **text_mapping(setup)}


def source_root(folder: Path) -> str:
    """Return the folder of the modules as the build files have it, or as people have it."""
    given = package_dir(folder).get("")
    if given is not None:
        return given
    find = _table(_pyproject(folder), "tool", "setuptools", "packages", "find")
    where = find.get("where")
    if isinstance(where, list) and where and isinstance(where[0], str):
        return where[0]
    listed = setup_cfg(folder).get("options.packages.find", "where", fallback="").strip()
    if listed:
        return listed
    return "src" if (folder / "src").is_dir() and not (folder / "CMakeLists.txt").is_file() else "."


def packages(folder: Path) -> set[str]:
    """Return the names of the packages that the build files list one by one."""
    listed = setup_cfg(folder).get("options", "packages", fallback="").replace(",", "\n")
    found = [*setup_py(folder).get("packages", ()), *listed.split()]
    table = _table(_pyproject(folder), "tool", "setuptools").get("packages")
    found += table if isinstance(table, list) else []
    return {name for name in map(str, found) if name.replace(".", "_").isidentifier()}


def console_scripts_in(setup_cfg_file: Path) -> dict[str, str]:
    """Return the console scripts that a ``setup.cfg`` elsewhere lists."""
    options = _configured(setup_cfg_file)
    return _targets(options.get(_ENTRY_POINTS, "console_scripts", fallback="").splitlines())


def entry_points(folder: Path) -> Groups:
    """Return the entry points that a package would have, were it installed."""
    found: Groups = {}
    given = setup_py(folder).get("entry_points", {})
    for group, lines in _of_setup_py(given):
        found.setdefault(group, {}).update(_targets(lines))
    listed = setup_cfg(folder)
    if listed.has_section(_ENTRY_POINTS):
        for group, text in listed[_ENTRY_POINTS].items():
            found.setdefault(group, {}).update(_targets(text.splitlines()))
    for group, targets in _of_pyproject(folder):
        if targets:
            found.setdefault(group, {}).update(targets)
    return {group: targets for group, targets in found.items() if targets}


class _CaseSensitiveParser(configparser.ConfigParser):
    def optionxform(self, optionstr: str) -> str:
        return optionstr


def _of_setup_py(given: object) -> Iterator[tuple[str, Iterable[object]]]:
    if isinstance(given, str):
        parser = _CaseSensitiveParser(delimiters=("=",), interpolation=None)
        try:
            parser.read_string(given)
        except configparser.Error:
            return
        for name in parser.sections():
            yield name, [f"{key}={value}" for key, value in parser[name].items()]
    elif isinstance(given, Mapping):
        for name, lines in given.items():
            yield str(name), lines.splitlines() if isinstance(lines, str) else lines


def _of_pyproject(folder: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Give the entry points of the standard's tables, and of those of an older Poetry."""
    pyproject = _pyproject(folder)
    yield "console_scripts", text_mapping(_table(pyproject, "tool", "poetry", "scripts"))
    yield "console_scripts", text_mapping(_table(pyproject, "project", "scripts"))
    yield "gui_scripts", text_mapping(_table(pyproject, "project", "gui-scripts"))
    for above in (("tool", "poetry", "plugins"), ("project", "entry-points")):
        for group, targets in _table(pyproject, *above).items():
            yield group, text_mapping(targets)


def _targets(lines: Iterable[object]) -> dict[str, str]:
    found = {}
    for line in lines:
        name, equals, target = str(line).partition("=")
        if equals:
            found[name.strip()] = target.strip()
    return found


def text_mapping(value: object) -> dict[str, str]:
    """Return a mapping with texts for keys and values; an empty one of anything else."""
    return {str(k): str(v) for k, v in value.items()} if isinstance(value, Mapping) else {}
