"""The tree that XML and YAML launch files have in common, every part with its place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from rsltrace.errors import JobError, did_you_mean
from rsltrace.job.reading.yaml_source import Place

Scalar = str | int | float | bool


@dataclass(frozen=True)
class Attribute:
    """A value as written: text (with substitutions in it), or a typed value or list of YAML."""

    value: Any
    place: Place


@dataclass(eq=False)
class Element:
    """One tag of a launch file."""

    tag: str
    place: Place
    attributes: dict[str, Attribute] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)

    def get(self, name: str) -> Attribute | None:
        """Return an attribute, or None if it is not given."""
        return self.attributes.get(name)

    def need(self, name: str) -> Attribute:
        """Return an attribute. Raises ``JobError`` if it is missing."""
        found = self.attributes.get(name)
        if found is None:
            raise self.place.error(f"<{self.tag}> needs the attribute '{name}'")
        return found

    def named(self, tag: str) -> list[Element]:
        """Return the children of a tag."""
        return [child for child in self.children if child.tag == tag]

    def check(self, attributes: Iterable[str], children: Iterable[str] | None = ()) -> None:
        """Raise ``JobError`` at anything else in it; ``children`` None: any."""
        allowed = [*attributes, "if", "unless"]
        for name, attribute in self.attributes.items():
            if name not in allowed:
                raise attribute.place.error(_unknown("attribute", name, self.tag, allowed))
        if children is None:
            return
        tags = list(children)
        for child in self.children:
            if child.tag not in tags:
                raise child.place.error(_unknown("element", child.tag, self.tag, tags))


def _unknown(what: str, name: str, tag: str, known: list[str]) -> str:
    there = f"there are {', '.join(known)}" if known else "it has none"
    return f"unknown {what} {name!r} in <{tag}>; {did_you_mean(name, known, there)}"


def not_a_launch_file(name: str, why: str) -> JobError:
    """Return the error that a file is no launch file."""
    return JobError(f"{why}; a launch file is <launch>…</launch> or 'launch: [...]'", where=name)
