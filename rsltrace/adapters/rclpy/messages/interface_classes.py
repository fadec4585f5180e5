"""Names of interfaces and their classes; imports each package on first use.

A name is ``package/kind/Type``, with kind ``msg``, ``srv`` or ``action``. Parts of a service or an
action are named as by rosidl: ``std_srvs/srv/Trigger_Request``.
"""

from __future__ import annotations

import difflib
import re
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from rsltrace.adapters.rclpy.hints import where_to_get
from rsltrace.errors import SetupError

_NAME = re.compile(r"(?P<package>[a-z]\w*)/(?P<kind>msg|srv|action)/(?P<type>[A-Z]\w*)", re.ASCII)


def get_message_class(name: str) -> type:
    """Return the class of a message, or of a message that is part of a service or action.

    Raises SetupError, saying what to install, if there is no such message.
    """
    found = _find(name)
    if not hasattr(found, "SLOT_TYPES"):
        raise SetupError(f"{name} is not a message{_parts_hint(name, found)}")
    return found


def get_service_class(name: str) -> type:
    """Return the class of a service, as `get_message_class` does."""
    found = _find(name)
    if not (hasattr(found, "Request") and hasattr(found, "Response")):
        raise SetupError(f"{name} is not a service{_parts_hint(name, found)}")
    return found


def type_name(interface: type) -> str:
    """Return the full name of an interface class; TypeError if rosidl did not generate it."""
    parts = interface.__module__.split(".")
    if len(parts) != 3 or parts[1] not in ("msg", "srv", "action"):
        raise TypeError(f"{interface!r} is not a ROS interface: rosidl did not generate it")
    return f"{parts[0]}/{parts[1]}/{interface.__name__}"


def class_of(publisher: Any) -> type:
    """Return a publisher's message class, also if it has only the type's name."""
    return getattr(publisher, "msg_type", None) or get_message_class(publisher.type_name)


def nested_class(namespaces: list[str], name: str) -> type:
    """Return the message class of rosidl's ``NamespacedType(namespaces, name)``."""
    return get_message_class("/".join([*namespaces, name]))


def forget_interfaces() -> None:
    """Clear the cache of classes: packages of one run are gone."""
    _find.cache_clear()


@cache
def _find(name: str) -> type:
    match = _NAME.fullmatch(name)
    if match is None:
        raise SetupError(
            f"{name!r} is not the name of an interface; "
            "write package/kind/Type, such as std_msgs/msg/String or std_srvs/srv/Trigger"
        )
    package, kind, type_ = match.group("package", "kind", "type")
    module = _import_kind(name, package, kind)
    found = getattr(module, type_, None)
    if found is None and "_" in type_:
        # The package does not export goals, results and feedback: they are in the module of their
        # action. Names of interfaces have no underscore, so the first part is the action's.
        whole = getattr(module, type_.split("_", 1)[0], None)
        if whole is not None:
            found = getattr(sys.modules[whole.__module__], type_, None)
    if not isinstance(found, type):
        raise SetupError(f"package {package} has no {kind} {type_}{_near(type_, module)}")
    return found


def _import_kind(name: str, package: str, kind: str) -> Any:
    try:
        if find_spec(package) is None:
            raise SetupError(
                f"{name} needs the package {package}, which this Python cannot import. "
                f"{where_to_get(package)}"
            )
        module = import_module(f"{package}.{kind}")
    except ModuleNotFoundError as error:
        if error.name == f"{package}.{kind}":
            raise SetupError(f"{name} does not exist: package {package} has no {kind}") from error
        raise SetupError(_broken(name, package, error)) from error
    except ImportError as error:
        raise SetupError(_broken(name, package, error)) from error
    if getattr(module, "__file__", None) is None:
        raise SetupError(
            f"{name}: {next(iter(module.__path__))} is a folder of sources, "
            "not a built package. Build its workspace and source it"
        )
    return module


def _broken(name: str, package: str, error: ImportError) -> str:
    return (
        f"{name}: package {package} is there but cannot be imported: {error}. "
        "Is the ROS 2 installation sourced, and built for this version of Python?"
    )


def _near(type_: str, module: Any) -> str:
    names = [key for key, value in vars(module).items() if isinstance(value, type)]
    near = difflib.get_close_matches(type_, names, 1)
    return f"; did you mean {near[0]}?" if near else ""


def _parts_hint(name: str, found: type) -> str:
    if hasattr(found, "Goal"):
        return f" but an action; its parts are {name}_Goal, {name}_Result and {name}_Feedback"
    if hasattr(found, "Request"):
        return f" but a service; its parts are {name}_Request and {name}_Response"
    if hasattr(found, "SLOT_TYPES"):
        return " but a message"
    return ""
