"""What MkDocs does with a page beyond Markdown: see ``hooks:`` in mkdocs.yml.

The pages are written for GitHub, too. So links to files beside ``docs/`` become links into the
repository, `` `docs/page.md` `` becomes a link with that page's title, and HTML comments (which say
how a test runs a block) are left out. ``<!-- made: NAME -->`` is replaced by what is made from the
code: commands, errors.
"""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path

import made
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
_APART = re.compile(r"^```.*?^```[^\n]*$|<!--.*?-->\n?", re.M | re.S)
_LINK = re.compile(r"\]\((?!\w+:|#)([^)\s#]+)(#[^)\s]*)?\)")
_PATH = re.compile(
    r"(?<!\[)`((?:docs|examples|benchmarks|sample_traces|tests)/[\w./-]*[\w/]|[\w-]+\.md)`"
)
_FROM_ELSEWHERE = re.compile(
    r"<(?:script|img|iframe|link(?=[^>]*rel=\"?(?:stylesheet|preload|preconnect|icon)))\b[^>]*"
    r"(?:src|href)=\"?(?:https?:)?//[^>]*>"
)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: object) -> str:
    """Return the text of a page as MkDocs is to read it."""
    parts = []
    last = 0
    for match in _APART.finditer(markdown):
        parts += [
            _prose(markdown[last : match.start()], page, config),
            _apart(match[0], page, config),
        ]
        last = match.end()
    parts.append(_prose(markdown[last:], page, config))
    return "".join(parts)


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse a site whose pages fetch anything from elsewhere."""
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        if found := _FROM_ELSEWHERE.search(path.read_text("utf-8")):
            raise PluginError(f"{path} is fetched from elsewhere: {found[0]}")


def _apart(text: str, page: Page, config: MkDocsConfig) -> str:
    if text.startswith("```"):
        return text
    name = re.fullmatch(r"<!-- made: (\w+) -->\n?", text)
    return on_page_markdown(made.PARTS[name[1]](), page, config) if name else ""


def _prose(text: str, page: Page, config: MkDocsConfig) -> str:
    folder = (Path(config.docs_dir) / page.file.src_uri).parent
    docs = Path(config.docs_dir)

    def link(match: re.Match[str]) -> str:
        target = Path(os.path.normpath(folder / match[1]))
        if target.is_relative_to(docs) or not target.exists():
            return match[0]  # MkDocs looks whether it is there
        return f"]({_in_repository(target, config)}{match[2] or ''})"

    def path(match: re.Match[str]) -> str:
        target = Path(os.path.normpath((ROOT if "/" in match[1] else folder) / match[1]))
        if target == docs / page.file.src_uri or not target.exists():
            return match[0]
        if target.suffix == ".md" and target.is_relative_to(docs):
            return f"[{_title(target)}]({os.path.relpath(target, folder)})"
        return f"[{match[0]}]({_in_repository(target, config)})"

    rows = _LINK.sub(link, text).split("\n")
    return "\n".join(row if row.startswith("#") else _PATH.sub(path, row) for row in rows)


def _in_repository(path: Path, config: MkDocsConfig) -> str:
    return f"{config.extra['repository']}/blob/main/{path.relative_to(ROOT).as_posix()}"


@cache
def _title(path: Path) -> str:
    found = re.search(r"^# (.*)$", path.read_text("utf-8"), re.M)
    return found[1] if found else path.stem
