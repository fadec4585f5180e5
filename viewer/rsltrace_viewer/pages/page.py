"""What all pages have in common: one file that loads nothing, in which every text stays text.

Names and messages come from traces, and a trace may come from anybody. Jinja2 escapes each value,
control characters are made visible, and the policy of the page lets nothing run or load but the
style and the script that are part of this package.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from rsltrace.trace.model.texts import printable_lines, shortened
from rsltrace.trace.words.entities import NODE_COLOURS

_FOLDER = Path(__file__).parent / "templates"
_TEXT_MAX, _REPORT_MAX = 4000, 100_000
_NODES = Markup("").join(
    Markup(f".c{number} rect {{ stroke: light-dark({light}, {dark}); stroke-width: 2 }}\n")
    for number, (dark, light) in enumerate(NODE_COLOURS)
)
"""The colours of nodes in a graph."""


def render_page(template: str, **values: object) -> str:
    style, script = _own("style.css") + _NODES, _own("script.js")
    policy = (
        f"default-src 'none'; style-src {_digest(style)}; script-src {_digest(script)}; "
        "base-uri 'none'; form-action 'none'"
    )
    made = _environment().get_template(template)
    return made.render(values, style=style, script=script, policy=policy) + "\n"


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(_FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalize,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(cut=shortened, report=_report)
    return made


def _finalize(value: object) -> object:
    """Return what a template shows of a value."""
    if value is None:
        return ""
    return shortened(printable_lines(value), _TEXT_MAX) if type(value) is str else value


def _report(text: str) -> Markup:
    """Return a text that may be longer than others."""
    return escape(shortened(printable_lines(text), _REPORT_MAX))


@cache
def _own(name: str) -> Markup:
    return Markup((_FOLDER / name).read_text(encoding="utf-8"))


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
