"""What the documents point at is there: files, headings, commands and their options."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import rsltrace
from rsltrace.cli.main import cli

ROOT = Path(__file__).parent.parent
PAGES = sorted(ROOT.glob("docs/**/*.md"))
DOCUMENTS = sorted([ROOT / "README.md", *PAGES, *ROOT.glob("*/*/README.md")])
_LINK = re.compile(r"\]\((?!https?:)([^)\s#]*)(#[^)\s]*)?\)")
_FILE = re.compile(r"`((?:docs|examples|benchmarks|sample_traces|tests)/[\w./-]*[\w/])`")
_CODE = re.compile(r"`((?:rsltrace|viewer)/[\w./-]+)`")
_FENCE = re.compile(r"^```.*?^```", re.M | re.S)
_TYPED = re.compile(r"\A```console$|^(?:\$|\(rsltrace\)|\(Pdb\)) ", re.M)
_RUN_OR_NOT = re.compile(r"<!-- (?:run(?:: \S+)?|not run: \w.{10,}) -->")
_OPTION = re.compile(r"(?<=\s)--?[a-zA-Z][\w-]*")

documents = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", _FENCE.sub("", text), re.M)
    return {
        "#" + re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")
        for heading in headings
    }


@documents
def test_links_lead_somewhere(path: Path) -> None:
    text = path.read_text("utf-8")
    for file, anchor in _LINK.findall(_FENCE.sub("", text)):
        target = path.parent / file if file else path
        assert target.exists(), f"{path}: {file}"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target.read_text("utf-8")), f"{path}: {file}{anchor}"
    for file in _FILE.findall(text):
        assert (ROOT / file).exists(), f"{path}: {file}"


def commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield every ``rsltrace COMMAND …`` of the document with its options."""
    for match in re.finditer(r"\brsltrace ([a-z]+)((?:[ \t]+[^\n`]*)?)", text):
        words = re.split(r"\s#\s|;|\||\s--ros-args\b|\s{4,}", match[2])[0]
        yield match[1], _OPTION.findall(re.sub(r"'[^']*'|\"[^\"]*\"", "''", words))


@documents
def test_commands_have_the_options_that_are_shown(path: Path) -> None:
    context = click.Context(cli)
    for name, options in commands(path.read_text("utf-8")):
        command = cli.get_command(context, name)
        if command is None:  # "rsltrace does …"
            assert not options, f"{path}: rsltrace {name} {options}"
            continue
        known = {opt for parameter in command.params for opt in parameter.opts}
        known |= {"--help", "-h", "--ros-args"}
        assert not set(options) - known, f"{path}: rsltrace {name}: {set(options) - known}"


def test_the_options_of_commands_are_looked_at() -> None:
    text = "`rsltrace record job.yaml -o x --frobnicate` and rsltrace diff a b --abs 'x=--y' # --no"
    assert list(commands(text)) == [("record", ["-o", "--frobnicate"]), ("diff", ["--abs"])]


def test_the_page_on_the_architecture_names_files_that_are_there() -> None:
    named = _CODE.findall((ROOT / "docs" / "architecture.md").read_text("utf-8"))
    assert len(named) > 20
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_the_drawings_of_the_concepts_are_current() -> None:
    drawing = runpy.run_path(str(ROOT / "docs" / "draw_concepts.py"))
    for name, draw in drawing["DRAWINGS"].items():
        assert (drawing["PICTURES"] / name).read_text("utf-8") == draw(), "run make docs"


def test_every_picture_is_drawn_and_shown() -> None:
    scripts = "".join(path.read_text("utf-8") for path in ROOT.glob("docs/draw_*.py"))
    shown = "".join(path.read_text("utf-8") for path in DOCUMENTS)
    for path in ROOT.glob("docs/pictures/*"):
        assert f'"{path.name}"' in scripts, f"{path}: no script draws it"
        assert f"pictures/{path.name})" in shown, f"{path}: no document shows it"


def test_the_picture_of_the_architecture_is_current_and_complete() -> None:
    drawing = runpy.run_path(str(ROOT / "docs" / "draw_architecture.py"))
    assert drawing["PICTURE"].read_text("utf-8") == drawing["architecture"](), "run make docs"
    drawn = {name for box in drawing["BOXES"] for name in re.findall(r"\w+", box.name)}
    packages = {path.parent.name for path in ROOT.glob("rsltrace/*/__init__.py")}
    assert packages <= drawn


@documents
def test_every_session_is_run_or_says_why_not(path: Path) -> None:
    unmarked = [fence.split("\n")[:3] for fence in sessions(path.read_text("utf-8"))]
    assert not unmarked, (
        f"{path}: put <!-- run --> before each of these blocks, and tests/run/"
        f"test_console_documents.py runs it, or <!-- not run: REASON -->: {unmarked}"
    )


def sessions(text: str) -> Iterator[str]:
    """Yield the blocks in which somebody types, and that no comment before them explains."""
    before = 0
    for fence in _FENCE.finditer(text):
        mark = text[before : fence.start()].rstrip("\n").rpartition("\n")[2]
        before = fence.end()
        if _TYPED.search(fence[0]) and not _RUN_OR_NOT.fullmatch(mark):
            yield fence[0]


def test_a_session_that_nobody_runs_is_noticed() -> None:
    block = "```console\n$ ls\n```\n"
    marked = "<!-- run -->\n", "<!-- run: husky -->\n", "<!-- not run: takes a robot -->\n"
    assert not any(list(sessions(f"text\n{mark}{block}")) for mark in marked)
    for mark in ("", "text\n", "<!-- not run -->\n", "<!-- not run: -->\n", "<!-- file: x -->\n"):
        assert len(list(sessions(f"<!-- run -->\n{block}{mark}{block}"))) == 1, mark
    assert list(sessions("```\n$ ls\n```\n"))
    assert list(sessions("```\n(rsltrace) up\n```\n"))
    assert not list(sessions("```yaml\na: $x\n```\n"))


def test_every_page_has_its_place_on_the_site() -> None:
    """mkdocs.yml is read as text: it holds a tag that only MkDocs knows."""
    nav = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    named = re.findall(r"[\w/-]+\.md", nav)
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in PAGES}
    assert len(named) == len(set(named))
    missing = sorted(pages - set(named))
    assert not missing, f"add these to nav: in mkdocs.yml, where a reader looks for them: {missing}"
    assert not set(named) - pages, "mkdocs.yml names pages that are not there"


def test_the_page_on_the_python_api_has_every_public_name() -> None:
    page = (ROOT / "docs" / "reference" / "python.md").read_text("utf-8")
    shown = re.findall(r"^::: rsltrace\.(\w+)$", page, re.M)
    assert sorted(shown) == sorted({*rsltrace.__all__} - {"__version__"})


@pytest.mark.parametrize("name", ["cart.py", "job.yaml"])
def test_the_tutorial_shows_the_example(name: str) -> None:
    tutorial = (ROOT / "docs" / "tutorial" / "index.md").read_text("utf-8")
    shown = re.search(rf"^<!-- file: {name} -->\n```\w+\n(.*?)^```", tutorial, re.M | re.S)
    assert shown is not None
    assert shown[1] == (ROOT / "examples" / "cart" / name).read_text("utf-8")


def test_the_manual_pages_are_current() -> None:
    # In a process of its own: commands that tests have called keep the help option of that call.
    script = ROOT / "docs" / "make_man_pages.py"
    make = f"import json, runpy; print(json.dumps(runpy.run_path({str(script)!r})['pages']()))"
    done = subprocess.run([sys.executable, "-c", make], capture_output=True, text=True, check=True)
    found = {path.name: path.read_text("utf-8") for path in ROOT.glob("man/*.1")}
    assert found == json.loads(done.stdout), "run make docs"
