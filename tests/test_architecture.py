"""What must not be imported, seen from outside in fresh processes."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

HEAVY = ("rclpy", "numpy", "pydantic", "rosbags", "textual", "rerun", "rich", "ruamel")


def loaded_after(code: str) -> set[str]:
    """Return which of the heavy packages a fresh interpreter has loaded after running ``code``."""
    probe = f"{code}\nimport sys\nprint(*[m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", probe], capture_output=True, text=True, check=True, timeout=300
    )
    return set(done.stdout.splitlines()[-1].split())


def test_importing_rsltrace_loads_nothing_heavy() -> None:
    assert loaded_after("import rsltrace; rsltrace.__version__; dir(rsltrace)") == set()


def test_help_and_version_load_nothing_heavy() -> None:
    for argument in ("--help", "--version"):
        code = (
            "import sys, contextlib\n"
            f"sys.argv = ['rsltrace', {argument!r}]\n"
            "from rsltrace.cli.main import main\n"
            "with contextlib.suppress(SystemExit):\n    main()\n"
        )
        assert loaded_after(code) == set()


@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("rsltrace.loop.loop", set()),
        ("rsltrace.model.event", set()),
        ("rsltrace.job", {"pydantic", "ruamel"}),
        ("rsltrace.trace.reader", {"numpy"}),
        ("rsltrace.trace.writer", {"numpy"}),
    ],
)
def test_layers_load_only_what_they_need(module: str, allowed: set[str]) -> None:
    assert loaded_after(f"import {module}") <= allowed


def test_every_public_name_exists() -> None:
    import rsltrace

    for name in rsltrace.__all__:
        if name == "record":
            pytest.importorskip("rclpy")
        assert getattr(rsltrace, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = rsltrace.nothing  # type: ignore[attr-defined]


def circles() -> set[frozenset[str]]:
    """Return the sets of modules that import each other, in functions and for types included."""
    graph = grimp.build_graph(
        "rsltrace", "rsltrace_viewer", exclude_type_checking_imports=False, cache_dir=None
    )
    above = {module: graph.find_upstream_modules(module) for module in graph.modules}
    together = {
        frozenset(other for other in (*imported, module) if module in (*above[other], other))
        for module, imported in above.items()
    }
    return {circle for circle in together if len(circle) > 1}


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert not circles(), "\n".join(" <-> ".join(sorted(circle)) for circle in circles())


_WRITES = re.compile(
    r"click\.(?:echo|secho)|(?<![\w.])print\(|std(?:out|err)\.write\(|print_exc|print_exception"
)
_MAY_WRITE = {"rsltrace/terminal.py"}
_OF_THE_BUILD = {
    "rsltrace/job/documents/reference.py",
    "viewer/rsltrace_viewer/rerun_export/picture.py",
}
"""Run by makers of the documents, with texts of our own."""


def test_one_place_writes_to_the_terminal() -> None:
    """Else a name in somebody's trace could set the title of a window, or hide a line."""
    root = Path(__file__).parents[1]
    found = {
        str(path.relative_to(root))
        for folder in ("rsltrace", "viewer")
        for path in (root / folder).rglob("*.py")
        if _WRITES.search(path.read_text(encoding="utf-8"))
    }
    assert found <= _MAY_WRITE | _OF_THE_BUILD
    assert found >= _MAY_WRITE


def test_files_that_the_guard_knows_by_their_path_are_there() -> None:
    from rsltrace.guard import callers

    for file in (callers._CALLS_BACK, callers._THREADS, *callers._STANDS_IN):
        assert Path(file).is_file()
    assert Path(callers._DOOR).is_dir()
