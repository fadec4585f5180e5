"""What there is in a run, so that a mistyped name is an error at once; topics named in texts."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from rsltrace.errors import ConditionError, did_you_mean, near_or_all
from rsltrace.trace.model.entity import WITH_TOPIC, Entity, EntityKind
from rsltrace.trace.model.finding import unseen_text
from rsltrace.trace.words.entities import is_named

Fields = Callable[[str], Mapping[str, str] | None]
"""By the name of an interface (``nav_msgs/msg/Odometry``), its fields and their types."""


def _no_fields(interface: str) -> None:
    return None


@dataclass(frozen=True, slots=True)
class RunNames:
    """The names of a run's nodes, topics (and services) and entities.

    Unless they ``are_all`` (the run may make more), a name that is none of them is no mistake.
    ``interfaces`` is by topic; ``fields`` knows those of an interface, or None. ``unseen`` has the
    process of each topic whose messages are in no trace.
    """

    nodes: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    entities: tuple[str, ...] = ()
    are_all: bool = False
    interfaces: Mapping[str, str] = field(default_factory=dict)
    fields: Fields = _no_fields
    unseen: Mapping[str, str] = field(default_factory=dict)

    def unknown(self, pattern: str, names: Iterable[str], what: str) -> str:
        """Return what is wrong with a pattern that has to fit one of ``names``, empty if nothing
        is."""
        names = tuple(names)
        if what.startswith("topic") and pattern in self.unseen:
            return unseen_text([pattern], self.unseen[pattern])
        if not self.are_all or any(is_named(pattern, name) for name in names):
            return ""
        return f"no {what} is called {pattern!r}{near_or_all(pattern, names)}"


def names_of(
    entities: Iterable[Entity],
    *,
    are_all: bool = True,
    fields: Fields = _no_fields,
    unseen: Mapping[str, str] | None = None,
) -> RunNames:
    """Return the names of entities, as those of a trace."""
    entities = tuple(entities)
    with_topic = [one for one in entities if one.kind in WITH_TOPIC]
    return RunNames(
        nodes=_each(one.name for one in entities if one.kind is EntityKind.NODE),
        topics=_each(one.name for one in with_topic),
        entities=_each(one.name for one in entities),
        are_all=are_all,
        interfaces={
            one.name: one.type
            for one in with_topic
            if one.kind in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)
        },
        fields=fields,
        unseen=unseen or {},
    )


def _each(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for name in names if name))


# Whether the fields that an expression reads of a message are fields of its interface.


_INTERFACE = re.compile(r"\w+(?:/\w+){1,2}")


class WrongField(NamedTuple):
    """A part of an expression that names a field which is not there."""

    node: ast.AST
    message: str


def wrong_field(tree: ast.expr, interface: str, fields: Fields) -> WrongField | None:
    """Return the first part of ``tree`` that reads a field which an interface does not have."""
    own = {
        node.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            inner = _type_of(node.value, interface, fields, own)
            known = fields(inner) if inner else None
            if known is not None and node.attr not in known:
                hint = did_you_mean(node.attr, known, f"it has {', '.join(known)}")
                return WrongField(node, f"{inner} has no field {node.attr!r}; {hint}")
    return None


def _type_of(node: ast.AST, interface: str, fields: Fields, own: set[str]) -> str:
    """Return the interface that a part of an expression is one of, empty if nobody can say."""
    if isinstance(node, ast.Name):
        if node.id == "msg":
            return interface
        if node.id in own:
            return ""
        return _interface((fields(interface) or {}).get(node.id, ""))
    if isinstance(node, ast.Attribute):
        outer = _type_of(node.value, interface, fields, own)
        return _interface((fields(outer) or {}).get(node.attr, "")) if outer else ""
    return ""


def _interface(text: str) -> str:
    """Return the full name of an interface as fields name it; empty for a number or a list."""
    if not _INTERFACE.fullmatch(text):
        return ""
    package, *_, name = text.split("/")
    return f"{package}/msg/{name}" if text.count("/") == 1 else text


def loaded_fields(interface: str) -> Mapping[str, str] | None:
    """Return the fields of an interface (``nav_msgs/msg/Odometry``) whose class is loaded; to look
    at a run must not import anything into it."""
    package, _, name = interface.partition("/")
    kind, _, name = name.partition("/")
    found = getattr(sys.modules.get(f"{package}.{kind}"), name, None)
    known = getattr(found, "get_fields_and_field_types", None)
    return None if known is None else dict(known())


# ``/odom.pose.x < 3``, another way to write ``/odom: msg.pose.x < 3``.

_TOPIC = r"/[A-Za-z_]\w*(?:/[A-Za-z_]\w*)*"
_BARE = re.compile(_TOPIC)
OF_MESSAGE = re.compile(rf"({_TOPIC})\s*:(?!:)\s*(.*)", re.DOTALL)
_DOTTED = re.compile(rf"(?:(?<=[\s(\[,<>=!+*%-])|\A)({_TOPIC})(?=\.[A-Za-z_])")


def with_topic_prefix(text: str) -> str:
    """Return a text with ``/odom.pose.x < 3`` written as ``/odom: msg.pose.x < 3``.

    :raises ConditionError: it speaks of several topics.
    """
    text = text.strip()
    if _BARE.fullmatch(text):
        return f"topic {text}"
    if OF_MESSAGE.match(text):
        return text
    topics = list(dict.fromkeys(_DOTTED.findall(text)))
    if len(topics) > 1:
        raise ConditionError(
            f"a condition is about messages of one topic, this one about {' and '.join(topics)}; "
            "compare them in a function",
            text,
        )
    return f"{topics[0]}: {_DOTTED.sub('msg', text)}" if topics else text


def topic_of(text: str) -> str | None:
    """Return the topic of a plain text that is about messages of one, else None."""
    found = OF_MESSAGE.match(text) or re.fullmatch(rf"topic ({_TOPIC})", text)
    return found[1] if found else None


def is_about_messages(text: str) -> bool:
    """Whether a text that may as well be words is a condition of messages: ``/odom: x > 1``, or
    ``/odom.x > 1``."""
    text = text.strip()
    if OF_MESSAGE.match(text):
        return True
    return _DOTTED.match(text) is not None and any(sign in text for sign in "<>=!")
