"""The rules for the names of nodes, namespaces, topics and services, with ROS's own texts.

They follow ``rmw_validate_*``, ``rcl_validate_topic_name`` and ``rcl_expand_topic_name``, which
count in bytes of UTF-8.
"""

from __future__ import annotations

import re

Fault = tuple[str, int]
"""What is wrong with a name, and where."""

_NAME_MAX = 255
_TOPIC_MAX = 247
_NAMESPACE_MAX = 245
_NOT_IN_NAMES = re.compile(rb"[^A-Za-z0-9_]")
_NOT_IN_PATHS = re.compile(rb"[^A-Za-z0-9_/]")
_NOTHING_BUT = "not contain characters other than"
_UNMATCHED = "topic name must not have unmatched (unbalanced) curly braces '{}'"
_TILDE = "topic name must not have a tilde '~'"
_BAD_START = re.compile(rb"/([/0-9])")
_SUBSTITUTION = re.compile(r"\{[^}]*\}")


def node_name_fault(name: str) -> Fault | None:
    """Return what is wrong with the name of a node, without namespace."""
    text = str.encode(name)
    if not text:
        return "node name must not be empty", 0
    if found := _NOT_IN_NAMES.search(text):
        return f"node name must {_NOTHING_BUT} alphanumerics or '_'", found.start()
    if text[:1].isdigit():
        return "node name must not start with a number", 0
    if len(text) > _NAME_MAX:
        return f"node name length should not exceed '{_NAME_MAX}'", _NAME_MAX - 1
    return None


def full_topic_fault(name: str) -> Fault | None:
    """Return what is wrong with the full name of a topic or service."""
    text = str.encode(name)
    fault = _path_fault(text, "topic name", "topic name must not end with a '/'")
    if fault is None and len(text) > _TOPIC_MAX:
        return "topic length should not exceed '255U - 8U'", _TOPIC_MAX - 1
    return fault


def namespace_fault(namespace: str) -> Fault | None:
    text = str.encode(namespace)
    if text == b"/":
        return None
    fault = _path_fault(text, "namespace", "namespace must not end with a '/', unless only a '/'")
    if fault is None and len(text) > _NAMESPACE_MAX:
        return "namespace should not exceed 'RMW_NAMESPACE_MAX_NAME_LENGTH'", _NAMESPACE_MAX - 1
    return fault


def _path_fault(text: bytes, what: str, slash_at_end: str) -> Fault | None:
    if not text:
        return f"{what} must not be empty", 0
    if text[:1] != b"/":
        return f"{what} must be absolute, it must lead with a '/'", 0
    if text.endswith(b"/"):
        return slash_at_end, len(text) - 1
    if found := _NOT_IN_PATHS.search(text):
        return f"{what} must {_NOTHING_BUT} alphanumerics, '_', or '/'", found.start()
    if found := _BAD_START.search(text):
        if found[1] == b"/":
            return f"{what} must not contain repeated '/'", found.start(1)
        return f"{what} must not have a token that starts with a number", found.start(1)
    return None


def topic_fault(name: str) -> Fault | None:
    """Return what is wrong with a topic or service name that may be relative, begin with ``~`` or
    have substitutions."""
    text = str.encode(name)
    if not text:
        return "topic name must not be empty string", 0
    if text[:1].isdigit():
        return "topic name token must not start with a number", 0
    if text.endswith(b"/"):
        return "topic name must not end with a forward slash", len(text) - 1
    opened = -1
    """Where the open substitution begins."""
    for at, code in enumerate(text):
        character = chr(code)
        inside = opened >= 0
        if character.isascii() and character.isalnum():
            if inside and at == opened + 1 and character.isdigit():
                return "substitution name must not start with a number", at
        elif character == "_" or (character == "/" and not inside):
            pass
        elif character == "~":
            if at != 0:
                return "topic name must not have tilde '~' unless it is the first character", at
        elif character == "}":
            if not inside:
                return _UNMATCHED, at
            opened = -1
        elif character == "{" and not inside:
            opened = at
        elif inside:
            return f"substitution name must {_NOTHING_BUT} alphanumerics or '_'", at
        else:
            return f"topic name must {_NOTHING_BUT} alphanumerics, '_', '~', '{{', or '}}'", at
    if opened >= 0:
        return _UNMATCHED, opened
    for at in range(len(text) - 1):
        if text[at : at + 1] == b"/":
            if text[at + 1 : at + 2].isdigit():
                return "topic name token must not start with a number", at + 1
        elif at == 1 and text[:1] == b"~":
            return f"{_TILDE} that is not followed by a forward slash '/'", 1
    return None


def expand(topic: str, node: str, namespace: str) -> str:
    """Return the full name of a topic or service of a node.

    :raises ValueError: if one of the three is not valid.
    """
    for name, what, fault in (
        (topic, "topic name", topic_fault(topic)),
        (node, "node name", node_name_fault(node)),
        (namespace, "node namespace", namespace_fault(namespace)),
    ):
        if fault is not None:
            raise ValueError(f"{what} '{name}' is invalid: {fault[0]}")
    if topic.startswith("~"):
        topic = f"{_below(namespace, node)}{topic[1:]}"

    def replaced(match: re.Match[str]) -> str:
        word = match[0]
        if word == "{node}":
            return node
        if word in ("{ns}", "{namespace}"):
            return namespace
        raise ValueError(f"topic name '{original}' is invalid: unknown substitution: {word}")

    original = topic
    topic = _SUBSTITUTION.sub(replaced, topic)
    return topic if topic.startswith("/") else _below(namespace, topic)


def _below(namespace: str, name: str) -> str:
    return f"{namespace}{name}" if len(namespace) == 1 else f"{namespace}/{name}"
