"""Makes Markdown of our docstrings: see ``extensions:`` in mkdocs.yml."""

from __future__ import annotations

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^>>> .*(?:\n(?!\s*$).*)*", re.M)
_RAISES = re.compile(r"^:raises ([\w, ]+):", re.M)


class Docstrings(griffe.Extension):
    """Puts ``>>>`` lines and what follows them into fences, and says in words what is raised."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object that has just been read."""
        if obj.docstring is not None:
            text = _EXAMPLE.sub(_fenced, obj.docstring.value)
            obj.docstring.value = _RAISES.sub(_raises, text)


def _fenced(example: re.Match[str]) -> str:
    text = re.sub(r" *# doctest: \+SKIP", "", example[0])
    return f"```pycon\n{text}\n```"


def _raises(field: re.Match[str]) -> str:
    return f"\n**Raises** {', '.join(f'`{name.strip()}`' for name in field[1].split(','))}:"
