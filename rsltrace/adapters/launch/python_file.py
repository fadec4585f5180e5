"""Reads Python launch files with rsltrace's own part of ``launch``: for a process of its own.

A Python launch file is a program, and may do to its process whatever it likes (see ``expand``).
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import logging
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import SequenceMatcher
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from rsltrace.adapters.launch.api import (
    actions,
    basics,
    events,
    nav2,
    nodes,
    parameters,
    settings,
    substitutions,
)
from rsltrace.adapters.launch.api import actions as conditions
from rsltrace.adapters.launch.api import actions as sources
from rsltrace.adapters.launch.api.actions import (
    MissingModuleError,
    get_launch_description_from_python_launch_file,
)
from rsltrace.adapters.launch.api.basics import (
    LaunchContext,
    LaunchDescription,
    as_job_error,
    shown,
)
from rsltrace.adapters.launch.api.substitutions import missing_packages_allowed
from rsltrace.adapters.launch.model import LaunchResult
from rsltrace.adapters.launch.reader import LaunchFileReader
from rsltrace.errors import JobError, nearest

# ROS's names for what is here: launch, launch_ros and their modules, while they are used. What
# ROS's have and these do not is refused by its name where a launch file uses it.


_ROOTS = ("launch", "launch_ros", "launch_xml", "launch_yaml", "nav2_common")
_WORD = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def _all(module: ModuleType) -> dict[str, Any]:
    """Return the classes of a module by name."""
    return {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type) and value.__module__ == module.__name__ and name[0] != "_"
    }


def _these(names: str, module: ModuleType) -> dict[str, Any]:
    return {name: getattr(module, name) for name in names.split()}


_ROS_SETTINGS = "SetParameter SetParametersFromFile SetRemap SetROSLogDir SetUseSimTime"
_ROS_SUBSTITUTIONS = "ExecutableInPackage FindPackagePrefix FindPackageShare"
_PROCESS_EVENTS = "ProcessExited ProcessIO ProcessStarted ShutdownProcess SignalProcess"
_HANDLERS = "OnExecutionComplete OnProcessExit OnProcessIO OnProcessStart OnShutdown"
_DESCRIPTIONS = _these("Parameter ParameterFile ParameterValue", parameters)
_SOURCE_FUNCTIONS = (
    "get_launch_description_from_python_launch_file load_python_launch_file_as_module"
)
_SOURCE = "AnyLaunchDescriptionSource LaunchDescriptionSource"

_MODULES: dict[str, dict[str, Any]] = {
    "launch": {
        **_these(
            "Action Condition LaunchContext LaunchDescription LaunchDescriptionEntity Substitution "
            "SubstitutionFailure",
            basics,
        ),
        **_these("Event EventHandler", events),
        **_these(_SOURCE, sources),
        "SomeSubstitutionsType": Any,
        "SomeEntitiesType": Any,
    },
    "launch.actions": {
        **_all(actions),
        **_these("ExecuteLocal ExecuteProcess", nodes),
        **_these("EmitEvent RegisterEventHandler UnregisterEventHandler", events),
        **{name: value for name, value in _all(settings).items() if "Ros" not in name},
        "Shutdown": events.ShutdownAction,
    },
    "launch.conditions": _all(conditions),
    "launch.substitutions": {
        **_all(substitutions),
        **_these("SubstitutionFailure TextSubstitution", basics),
    },
    "launch.events": _these("Event Shutdown matches_action", events),
    "launch.events.process": _these(_PROCESS_EVENTS, events),
    "launch.events.matchers": _these("matches_action", events),
    "launch.event_handlers": _these(_HANDLERS, events),
    "launch.launch_description_sources": {
        **_all(sources),
        **_these(_SOURCE_FUNCTIONS, sources),
        "LaunchContext": basics.LaunchContext,
    },
    "launch.utilities": {
        "normalize_to_list_of_substitutions": basics.as_substitutions,
        "perform_substitutions": basics.perform_substitutions,
    },
    "launch.frontend": {
        "expose_action": lambda _: lambda kind: kind,
        "expose_substitution": lambda _: lambda kind: kind,
    },
    "launch.logging": {"get_logger": logging.getLogger},
    "launch_ros": {},
    "launch_ros.actions": {
        **_all(nodes),
        **_these(_ROS_SETTINGS, settings),
        "PushRosNamespace": settings.PushRosNamespace,
        "PushROSNamespace": settings.PushRosNamespace,
        "RosTimer": actions.TimerAction,
        "ROSTimer": actions.TimerAction,
    },
    "launch_ros.substitutions": _these(_ROS_SUBSTITUTIONS, substitutions),
    "launch_ros.descriptions": {"ComposableNode": nodes.ComposableNode, **_DESCRIPTIONS},
    "launch_ros.parameter_descriptions": _DESCRIPTIONS,
    "launch_ros.event_handlers": _these("OnStateTransition", events),
    "launch_ros.events": {},
    "launch_ros.events.lifecycle": {
        **_these("ChangeState StateTransition", events),
        "matches_node_name": lambda *_, **__: events.matches_action(None),
    },
    "launch_xml": {},
    "launch_xml.launch_description_sources": _these("XMLLaunchDescriptionSource", sources),
    "launch_yaml": {},
    "launch_yaml.launch_description_sources": _these("YAMLLaunchDescriptionSource", sources),
    "nav2_common": {},
    "nav2_common.launch": _all(nav2),
}


class _LaunchModule(ModuleType):
    """A module of ROS's launch, with what there is of it here."""

    def __getattr__(self, name: str) -> Any:
        """Return a class that refuses to be used: a launch file may import what it never uses."""
        if name.startswith("_") or not name[:1].isupper():
            raise AttributeError(f"rsltrace has no {self.__name__}.{name}")
        near = nearest(name, vars(self))
        total = len(name) + len(near or "")
        if near and SequenceMatcher(None, name, near).ratio() * total > total - 4:
            # "from ... import" would lose the text of an AttributeError.
            raise ImportError(f"there is no {self.__name__}.{name}; did you mean {near!r}?")
        places = [place for place, names in _MODULES.items() if name in names]
        return _refused(f"{self.__name__}.{name}", [f"{place}.{name}" for place in places[:1]])


def _refused(name: str, meant: Sequence[str]) -> type:
    def refuse(*_: Any, **__: Any) -> None:
        raise _unknown("part", name, meant)

    return type(name.rpartition(".")[2], (), {"__init__": refuse})


def _unknown(what: str, name: str, meant: Iterable[str]) -> JobError:
    known = "".join(f"did you mean {one!r}? Else " for one in meant)
    return JobError(
        f"{name}: this {what} of ROS's launch is not among what rsltrace knows: {known}source a "
        "ROS 2 installation, or name the nodes in the job",
        where=basics.calling_line(),
    )


def _submodules(modules: Mapping[str, dict[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give the modules that ROS has each class in: ``launch.actions.opaque_function``."""
    for module, names in modules.items():
        for name, value in names.items():
            if name[:1].isupper():
                yield f"{module}.{'_'.join(_WORD.split(name)).lower()}", {name: value}


class _LaunchModuleFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the modules of ``roots``."""

    def __init__(self, roots: Sequence[str]) -> None:
        self._roots = roots
        self._modules = {**dict(_submodules(_MODULES)), **_MODULES}

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the spec of a module of launch. Raises ``JobError`` if it is not known here."""
        if name.partition(".")[0] not in self._roots:
            return None
        if name.rpartition(".")[2][:1].isupper():  # a class that is not there
            return None
        if name not in self._modules:
            raise _unknown("module", name, filter(None, [nearest(name, self._modules)]))
        return importlib.machinery.ModuleSpec(name, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return _LaunchModule(spec.name, "A stand-in of rsltrace for a module of ROS's launch.")

    def exec_module(self, module: ModuleType) -> None:
        """Fill the module; those below it come with it, as in ROS."""
        vars(module).update(self._modules[module.__name__])
        for name in _MODULES:
            parent, _, own = name.rpartition(".")
            if parent == module.__name__:
                vars(module)[own] = importlib.import_module(name)


@contextmanager
def own_launch() -> Iterator[None]:
    """Let ``import launch`` and its like find what is here, for a process that ends soon after.

    A ``launch`` that is installed without ``launch_ros`` is not ROS's.
    """
    roots = [name for name in _ROOTS if name != "nav2_common" or find_spec(name) is None]
    finder = _LaunchModuleFinder(roots)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


def read_launch_file(path: Path, arguments: Mapping[str, str]) -> LaunchResult:
    """Return what a launch file starts, given ``name:=value`` arguments.

    :raises JobError: with file and line, if something in it is wrong, missing or not known here.
    """
    reader = LaunchFileReader(arguments, _load)
    with own_launch(), missing_packages_allowed(reader.context):
        return reader.read(path)


def _load(context: LaunchContext, file: Path) -> LaunchDescription:
    os.environ.update(context.environment)
    here = str(file)
    try:
        description = get_launch_description_from_python_launch_file(here)
    except JobError:
        raise
    except ModuleNotFoundError as error:
        where = as_job_error(error, shown(here)).where
        raise MissingModuleError(
            f"it imports the Python module {error.name!r}, which is not installed for "
            f"{sys.executable}: install it, or add the folder of its sources to search_path",
            where=where,
        ) from error
    except SystemExit as error:
        raise JobError(f"the launch file ends Python ({error.code})", where=shown(here)) from error
    except Exception as error:
        raise as_job_error(error, shown(here)) from error
    if not isinstance(description, LaunchDescription):
        raise JobError(
            f"generate_launch_description() returned {type(description).__name__}, not a "
            "LaunchDescription",
            where=shown(here),
        )
    return description
