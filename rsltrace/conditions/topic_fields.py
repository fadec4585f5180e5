"""``/odom.pose.x < 3``, another way to write ``/odom: msg.pose.x < 3``."""

from __future__ import annotations

import re

from rsltrace.errors import ConditionError

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
