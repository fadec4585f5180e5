"""A YAML launch file as the same elements an XML one has."""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.launch.element import Attribute, Element, not_a_launch_file
from rsltrace.job.reading.yaml_source import Item, parse_yaml
from rsltrace.job.values.times import ExactFloat


def parse_launch_yaml(text: str, name: str, folder: str) -> Element:
    """Return the ``launch`` element. Raises ``JobError`` with the place of a mistake."""
    root = parse_yaml(text, name, folder=folder).root
    if root is None:
        raise not_a_launch_file(name, "the file is empty")
    if not isinstance(root.value, dict) or list(root.value) != ["launch"]:
        raise root.place.error("a YAML launch file has one key, 'launch', with a list below it")
    return _element("launch", root.value["launch"])


def _element(tag: str, item: Item) -> Element:
    element = Element(tag, item.key_place or item.place)
    if isinstance(item.value, list):
        element.children = _entities(item)
        return element
    if not isinstance(item.value, dict):
        raise item.place.error(f"{tag!r} takes a mapping (name: value), not {item.plain()!r}")
    for key, inner in item.value.items():
        name = str(key)
        if name == "children":
            element.children += _entities(inner)
        elif _is_list_of_mappings(inner):
            element.children += [_element(name, one) for one in inner.value]
        elif isinstance(inner.value, dict):
            raise inner.place.error(f"{name!r} in {tag!r} takes a value or a list, not a mapping")
        else:
            place = inner.key_place or inner.place
            element.attributes[name] = Attribute(_plain(inner.plain()), place)
    return element


def _entities(item: Item) -> list[Element]:
    if not isinstance(item.value, list):
        raise item.place.error("expected a list of actions (- node: …)")
    found = []
    for one in item.value:
        if not isinstance(one.value, dict) or len(one.value) != 1:
            raise one.place.error("an action is a mapping with one key, its kind (- node: …)")
        ((tag, inner),) = one.value.items()
        found.append(_element(str(tag), inner))
    return found


def _is_list_of_mappings(item: Item) -> bool:
    return isinstance(item.value, list) and any(isinstance(one.value, dict) for one in item.value)


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if value is None:
        return ""
    return float(value) if isinstance(value, ExactFloat) else value
