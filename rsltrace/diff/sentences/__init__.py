"""The sentences of a diff, made from facts. Only this package makes them; nothing reads them.

``sentence(fact, of)`` looks up the sentence for a fact: by its class, or itself for a member of an
enum. ``of`` is what the fact belongs to (a ``Judgement`` or a ``Diff``). The modules of this
package fill the table: ``divergence``, ``runs``, and ``values`` for what is inside of sentences,
each with ``@says`` for a function and at its end for what fits into one line.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, TypeVar

Sentence = Callable[[Any, Any], str]
_Made = TypeVar("_Made", bound=Sentence)

SENTENCES: dict[Any, Sentence] = {}


def says(*facts: Any) -> Callable[[_Made], _Made]:
    """Make a function the one that puts some facts in words."""

    def add(made: _Made) -> _Made:
        SENTENCES.update(dict.fromkeys(facts, made))
        return made

    return add


def sentence(fact: Any, of: Any = None) -> str:
    return SENTENCES[fact if isinstance(fact, Enum) else type(fact)](fact, of)
