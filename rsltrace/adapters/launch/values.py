"""Values of parameters in launch files: what a text or a typed YAML value becomes."""

from __future__ import annotations

from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import YAMLError

from rsltrace.trace.model.nesting import nested_too_deep


class _Constructor(SafeConstructor):
    """Reads what ROS's launch writes, too: it has tuples where a file has lists.

    Names are text, even if they are ``n`` or ``on``.
    """

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Return a mapping."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:bool":
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)


_Constructor.add_constructor(
    "tag:yaml.org,2002:python/tuple",
    lambda constructor, node: constructor.construct_sequence(node, deep=True),
)


def yaml_value(text: str) -> Any:
    """Return what YAML 1.1 (that of ROS) reads, or the text itself where it is not YAML."""
    if nested_too_deep(text) >= 0:
        return text
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _Constructor
    yaml.version = (1, 1)
    try:
        return yaml.load(text)
    except (YAMLError, ValueError):
        return text


def inferred(text: str) -> Any:
    """Return a number, a truth value or a list if the text is one, else the text."""
    value = yaml_value(text)
    if isinstance(value, list) and value and all(isinstance(v, type(value[0])) for v in value):
        return value if isinstance(value[0], (bool, int, float, str)) else text
    return value if isinstance(value, (bool, int, float)) else text


def typed(value: Any, kind: str | None) -> Any:
    """Return ``value`` as ``kind`` (``int``, ``list_of_str``, …; None: as it looks).

    :raises ValueError: if it is none, or there is no such kind.
    """
    if kind is None:
        return inferred(value) if isinstance(value, str) else value
    if kind == "yaml":
        return yaml_value(value) if isinstance(value, str) else value
    if kind.startswith("list_of_"):
        items = yaml_value(value) if isinstance(value, str) else value
        if not isinstance(items, list):
            raise ValueError(f"expected a list ([a, b]), got {value!r}")
        return [_one(item, kind.removeprefix("list_of_")) for item in items]
    return _one(value, kind)


def _one(value: Any, kind: str) -> Any:
    if kind == "str":
        return value if isinstance(value, str) else str(value)
    found = yaml_value(value) if isinstance(value, str) else value
    if kind == "bool" and isinstance(found, bool):
        return found
    if kind == "int" and isinstance(found, int) and not isinstance(found, bool):
        return found
    if kind == "float" and isinstance(found, (int, float)) and not isinstance(found, bool):
        return float(found)
    if kind not in ("bool", "int", "float"):
        raise ValueError(
            f"unknown type {kind!r}: there are bool, int, float, str, yaml and list_of_ these"
        )
    raise ValueError(f"expected {kind}, got {value!r}")
