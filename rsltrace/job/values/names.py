"""ROS naming rules, checked while the job is read.

A wrong name would otherwise fail inside rcl, in the middle of a run and without a line number.
rclpy is not imported here (a job is read on machines without ROS); a test compares with rclpy.
"""

from __future__ import annotations

import re
from typing import Any

NODE_NAME_LENGTH_MAX = 255
NAMESPACE_LENGTH_MAX = 245

# Compiled when a job has such a name: all of them take as long as the rest of reading a job.
_PART = r"[A-Za-z_][A-Za-z0-9_]*"
_NODE_NAME = rf"(?a){_PART}"
_NAMESPACE = rf"(?a)/|(?:/{_PART})+"
_VARIABLE = r"(?a)[A-Za-z_][A-Za-z0-9_-]*"
_TOPIC = rf"(?a)(?:/{_PART})+"
_FIELD_PATH = r"(?a)[A-Za-z][A-Za-z0-9_]*(?:\.[A-Za-z][A-Za-z0-9_]*)*"

# In a remapping rule rcl's lexer knows no double underscores inside a name.
_TOKEN = rf"(?![A-Za-z0-9_]*__){_PART}"
_RULE_NAME = rf"(?:~/|/)?{_TOKEN}(?:/{_TOKEN})*"
_REMAP_FROM = rf"(?a)(?:{_TOKEN}:)?(?:rostopic://|rosservice://)?{_RULE_NAME}"
_REMAP_TO = rf"(?a){_RULE_NAME}"

_MODULE = r"[^\W\d]\w*(?:\.[^\W\d]\w*)*"
_TARGET = rf"{_MODULE}:{_MODULE}"
_FILE_TARGET = rf"(?:\./)?((?:[^\W\d]\w*/)*[^\W\d]\w*)\.py:({_MODULE})"
_EXECUTABLE = r"(?a)[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+"
_COMPONENT = r"(?a)[A-Za-z0-9_.-]+/[A-Za-z_]\w*(?:(?:::|[.:])[A-Za-z_]\w*)*"


def check_node_name(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` can be a ROS node name."""
    if not re.fullmatch(_NODE_NAME, name):
        raise ValueError(
            f"{name!r} is not a node name: use letters, digits and '_', not starting with a digit"
        )
    if len(name) > NODE_NAME_LENGTH_MAX:
        raise ValueError(
            f"a node name has at most {NODE_NAME_LENGTH_MAX} characters, this one has {len(name)}"
        )


def check_namespace(namespace: str) -> None:
    """Raise ``ValueError`` unless ``namespace`` can be a ROS namespace: ``/`` or ``/a/b``."""
    if not namespace.startswith("/") and re.fullmatch(_NAMESPACE, f"/{namespace}"):
        raise ValueError(f"a namespace starts with '/': write '/{namespace}'")
    if not re.fullmatch(_NAMESPACE, namespace):
        raise ValueError(
            f"{namespace!r} is not a namespace: parts of letters, digits and '_', none starting "
            "with a digit, after one '/' each and with none at the end"
        )
    if len(namespace) > NAMESPACE_LENGTH_MAX:
        raise ValueError(
            f"a namespace has at most {NAMESPACE_LENGTH_MAX} characters, this one has "
            f"{len(namespace)}"
        )


def check_topic(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` is a fully qualified topic name."""
    if not name.startswith("/") and re.fullmatch(_TOPIC, f"/{name}"):
        raise ValueError(f"a topic is named in full, from '/': write '/{name}'")
    if not re.fullmatch(_TOPIC, name):
        raise ValueError(
            f"{name!r} is not a topic name: parts of letters, digits and '_', none starting with "
            "a digit, after one '/' each, as in /robot/scan"
        )


def check_container(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` is a node's name in full."""
    if not name.startswith("/") and re.fullmatch(_TOPIC, f"/{name}"):
        raise ValueError(f"a node is named in full here, from '/': write '/{name}'")
    if not re.fullmatch(_TOPIC, name):
        raise ValueError(f"{name!r} is not the name of a node in full, as in /camera/container")


def check_field_path(path: str) -> None:
    """Raise ``ValueError`` unless ``path`` is a field of a message: ``data``, ``header.seq``."""
    if not re.fullmatch(_FIELD_PATH, path):
        raise ValueError(f"{path!r} is not a field: write its name, or a path such as status.code")


def check_target(target: str) -> None:
    """Raise ``ValueError`` unless ``target`` looks like ``module:Class`` (dots in both parts)."""
    if not re.fullmatch(_TARGET, target) or target.partition(":")[0].endswith(".py"):
        raise ValueError(
            f"expected module:Class or module:function, got {target!r}{_as_target(target)}"
        )


def dotted_target(target: str) -> str:
    """Return ``path/to/file.py:Class`` as ``path.to.file:Class``, which is the same module seen
    from the job's folder; another text as it is."""
    found = re.fullmatch(_FILE_TARGET, target)
    return target if found is None else f"{found[1].replace('/', '.')}:{found[2]}"


def _as_target(text: str) -> str:
    """Say how to write what was probably meant: a dotted name, or the path of a module."""
    path, _, attribute = text.partition(":")
    folder, _, file = path.removesuffix(".py").rpartition("/")
    module = f"{folder}/{file}".replace("/", ".").strip(".")
    if path and (attribute or path.endswith(".py")) and not re.fullmatch(_MODULE, file):
        return f"; {file!r} cannot be a module's name: rename the file, or run it with script:"
    if path.endswith(".py"):
        below = not path.startswith(("/", "../")) and re.fullmatch(_MODULE, module)
        if attribute and not below:
            return f"; add {folder or '/'} to search_path and write {file}:{attribute}"
        return f"; a module is named with dots: {module}:{attribute or 'Class'}"
    module, dot, last = text.rpartition(".")
    if not dot or not re.fullmatch(_TARGET, f"{module}:{last}"):
        return ""
    in_module = "" if last[:1].isupper() else f"{text}:Class, or "
    return f"; write {in_module}{module}:{last}"


def check_executable(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` looks like ``package/executable``."""
    if not re.fullmatch(_EXECUTABLE, name):
        raise ValueError(f"expected package/executable (as ros2 run has them), got {name!r}")


def check_component(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` looks like ``package/name::Class``."""
    if not re.fullmatch(_COMPONENT, name):
        raise ValueError(
            "expected package/plugin (as ros2 component types has them, package/name::Class), got "
            f"{name!r}"
        )


def check_module(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` looks like ``package.module``."""
    if not re.fullmatch(_MODULE, name) or name.endswith(".py"):
        path = name.partition(":")[0]
        hint = f"; a file is named by 'script: {name}'" if path.endswith(".py") else ""
        hint = hint or (f"; a function is named by 'main: {name}'" if ":" in name else "")
        raise ValueError(f"expected package.module (as in python -m), got {name!r}{hint}")


def check_variable(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` can be a variable of a job."""
    if not re.fullmatch(_VARIABLE, name):
        raise ValueError(
            f"{name!r} is not a variable's name: use letters, digits, '_' and '-', not starting "
            "with a digit"
        )


def check_remap_from(name: str) -> None:
    """Raise ``ValueError`` unless rcl accepts ``name`` on the left of a remapping rule."""
    if name in ("__node", "__name", "__ns"):
        key = "namespace" if name == "__ns" else "name"
        raise ValueError(f"{name} is not a topic or service: use the node's '{key}:' instead")
    if not re.fullmatch(_REMAP_FROM, name):
        raise ValueError(
            f"rcl cannot remap {name!r}: write a topic or service name such as chatter, "
            "/robot/chatter or ~/chatter (no wildcards, no '__')"
        )


def check_remap_to(name: str) -> None:
    """Raise ``ValueError`` unless rcl accepts ``name`` on the right of a remapping rule."""
    if not re.fullmatch(_REMAP_TO, name):
        raise ValueError(
            f"rcl cannot remap to {name!r}: write a topic or service name such as chatter, "
            "/robot/chatter or ~/chatter (no wildcards, no '__', no '/' at the end)"
        )


def check_glob(glob: str) -> None:
    """Raise ``ValueError`` unless ``glob`` can match a topic name."""
    _check_glob(glob, "topic")


def check_service_glob(glob: str) -> None:
    """Raise ``ValueError`` unless ``glob`` can match the name of a service."""
    _check_glob(glob, "service")


def check_node_glob(glob: str) -> None:
    """Raise ``ValueError`` unless ``glob`` can match a node's name with its namespace."""
    _check_glob(glob, "node")


def _check_glob(glob: str, what: str) -> None:
    if not glob:
        raise ValueError(f"an empty pattern matches no {what}: write the name of one, or a glob")
    if glob[0] not in "/*?[":
        raise ValueError(f"{what} names start with '/': write '/{glob}' (or '*{glob}')")


# What the rules accept, for the JSON Schema (whose regular expressions are JavaScript's).
_PATTERNS: tuple[tuple[Any, str], ...] = (
    (check_node_name, rf"^{_PART}$"),
    (check_namespace, rf"^(/|(/{_PART})+)$"),
    (check_topic, rf"^(/{_PART})+$"),
    (check_variable, r"^[A-Za-z_][A-Za-z0-9_-]*$"),
    (check_field_path, r"^[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z][A-Za-z0-9_]*)*$"),
    (check_target, r"^[^\s:]+:[^\s:]+$"),
    (check_executable, r"^[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+$"),
    (check_component, r"^[A-Za-z0-9_.-]+/[A-Za-z_][A-Za-z0-9_:.]*$"),
    (check_container, rf"^(/{_PART})+$"),
    (check_module, r"^[^\s:./]+(\.[^\s:./]+)*$"),
    (check_remap_from, r"^[A-Za-z0-9_~/:]+$"),
    (check_remap_to, r"^[A-Za-z0-9_~/]+$"),
    (check_glob, r"^[/*?\[]"),
    (check_service_glob, r"^[/*?\[]"),
    (check_node_glob, r"^[/*?\[]"),
)
for _rule, _pattern in _PATTERNS:
    _rule.pattern = _pattern
