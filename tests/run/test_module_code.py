"""What is kept of the code of modules: comments and layout do not count, imports are followed."""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run.provenance import SourceHashes, environment, module_code, source_files
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

CODE = 'import pkg.gains\n\n\ndef go(x):\n    """Go."""\n    return [x, 1.5]\n'


def code_hash(folder: Path, text: str | bytes) -> str:
    path = folder / "node.py"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return str(json.loads(module_code({"node": path})["node"])["hash"])


@pytest.mark.parametrize(
    "same",
    [
        CODE.replace("\n\n\n", "\n# what this does\n\n"),
        CODE.replace("[x, 1.5]", "[\n        x,  # the first\n        1.50,\n    ]"),
        CODE.replace("return [x, 1.5]", "return ([x, 1.5])"),
        CODE.replace("\n", "\r\n"),
    ],
)
def test_comments_and_layout_are_no_change(tmp_path: Path, same: str) -> None:
    assert code_hash(tmp_path, same) == code_hash(tmp_path, CODE)


@pytest.mark.parametrize(
    "other",
    [
        CODE.replace("1.5", "1.6"),
        CODE.replace("Go.", "Stop."),
        CODE.replace("[x, 1.5]", "(x, 1.5)"),
        CODE.replace("def go(x)", "async def go(x)"),
    ],
)
def test_anything_else_is_a_change(tmp_path: Path, other: str) -> None:
    assert code_hash(tmp_path, other) != code_hash(tmp_path, CODE)


@pytest.mark.parametrize(
    ("name", "text", "same", "other"),
    [
        ("p.yaml", "n: {gain: 1.0}\n", "# why\nn:\n  gain: 1.0  # so\n", "n: {gain: '1.0'}\n"),
        (
            "A.msg",
            "int8 UP=1\nint8 way\n",
            "# up\nint8  UP=1 # up\n\nint8 way",
            "int8 UP=2\nint8 way",
        ),
    ],
    ids=["parameters", "definition"],
)
def test_comments_of_parameters_and_definitions_are_no_change(
    tmp_path: Path, name: str, text: str, same: str, other: str
) -> None:
    found = []
    for one in (text, same, other):
        (tmp_path / name).write_text(one)
        found.append(module_code({name: tmp_path / name})[name])
    assert found[0] == found[1] != found[2]


def test_yaml_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text("a: [")
    assert module_code({"p.yaml": tmp_path / "p.yaml"}) == {}


def test_definitions_of_the_interfaces_of_a_workspace_are_hashed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Constants and defaults are in no schema of a trace."""
    package = tmp_path / "install/lib/python3/site-packages/dock_msgs/msg"
    definition = tmp_path / "install/share/dock_msgs/msg/State.msg"
    for folder in (package, definition.parent):
        folder.mkdir(parents=True)
    for file in (package / "__init__.py", package.parent / "__init__.py"):
        file.touch()
    definition.write_text("uint8 DOCKED=1\n")
    monkeypatch.syspath_prepend(package.parents[1])
    importlib.import_module("dock_msgs.msg")
    (tmp_path / "job.yaml").write_text("nodes: [{program: ./none}]\nstop: {duration: 1s}\n")
    (tmp_path / "none").touch(0o755)
    try:
        found = source_files(load_job(tmp_path / "job.yaml"))
    finally:
        for name in ("dock_msgs.msg", "dock_msgs"):
            del sys.modules[name]
    assert found["file:dock_msgs/msg/State.msg"] == definition


def test_imports_are_those_of_the_modules_that_are_known(tmp_path: Path) -> None:
    texts = {
        "pkg": "",
        "pkg.node": "import os, pkg.gains as g\nfrom . import filters\nfrom .deep import a\n",
        "pkg.gains": "def late():\n    from .filters import low_pass\n",
        "pkg.filters": "",
        "pkg.deep.a": "from ..gains import G\nimport numpy\n",
        "pkg.deep": "from ... import nothing\n",
    }
    files = {}
    for number, (name, text) in enumerate(texts.items()):
        is_package = name in ("pkg", "pkg.deep")
        files[name] = tmp_path / str(number) / ("__init__.py" if is_package else "module.py")
        files[name].parent.mkdir()
        files[name].write_text(text)
    found = {name: json.loads(text)["imports"] for name, text in module_code(files).items()}
    assert found == {
        "pkg": [],
        "pkg.node": ["pkg", "pkg.deep", "pkg.deep.a", "pkg.filters", "pkg.gains"],
        "pkg.gains": ["pkg", "pkg.filters"],
        "pkg.filters": [],
        "pkg.deep.a": ["pkg", "pkg.gains"],
        "pkg.deep": [],
    }


@pytest.mark.parametrize(
    ("call", "found"),
    [
        ("importlib.import_module('plugins.fast')", ["plugins.fast"]),
        ("importlib.import_module('plugins.' + NAME)", ["plugins.fast", "plugins.slow"]),
        ("import_module(f'plugins.{NAME}')", ["plugins.fast", "plugins.slow"]),
        ("__import__(NAME)", ["other", "plugins.fast", "plugins.slow"]),
        ("import_module('.fast', __package__)", ["other", "plugins.fast", "plugins.slow"]),
        ("import_module(f'')", ["other", "plugins.fast", "plugins.slow"]),
        ("load('plugins.fast')", []),
    ],
)
def test_modules_that_are_imported_by_name(tmp_path: Path, call: str, found: list[str]) -> None:
    files = {}
    for name in ("node", "other", "plugins.fast", "plugins.slow"):
        files[name] = tmp_path / f"{name}.py"
        files[name].write_text(f"plugin = {call}\n" if name == "node" else "")
    assert json.loads(module_code(files)["node"])["imports"] == found


@pytest.mark.filterwarnings("error")
def test_what_is_not_python_is_left_out(tmp_path: Path) -> None:
    files = {}
    for name, text in (("bad.py", "def ("), ("nul.py", "a\0"), ("x.so", "1"), ("odd.py", r"'\d'")):
        files[name] = tmp_path / name
        files[name].write_text(text)
    files["gone"] = tmp_path / "gone.py"
    assert list(module_code(files)) == ["odd.py"]


def test_a_file_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    """As of a module in an archive, or one that is gone since Python has loaded it."""
    (tmp_path / "node.py").write_text(CODE)
    (tmp_path / "lib.zip").touch()
    files = {name: tmp_path / name for name in ("node.py", "lib.zip/inside.py", "gone.py")}
    with TraceWriter(tmp_path / "a.mcap", force=False) as writer:
        SourceHashes(writer, files)
    with Trace.open(tmp_path / "a.mcap") as trace:
        assert [*trace.metadata(METADATA_SOURCES)] == ["node.py"]


def test_parameter_files_of_command_lines_are_hashed(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text("/**: {ros__parameters: {gain: 1}}\n")
    (tmp_path / "none").touch(0o755)
    (tmp_path / "q.yaml").write_text("/**: {ros__parameters: {gain: 2}}\n")
    (tmp_path / "job.yaml").write_text(
        "nodes:\n  - {program: ./none, arguments: [--ros-args, --params-file, p.yaml]}\n"
        "ros_arguments: [--params-file, q.yaml]\nstop: {duration: 1s}\n"
    )
    found = source_files(load_job(tmp_path / "job.yaml"))
    assert {"file:p.yaml", "file:q.yaml"} <= set(found)


def test_parameter_files_of_nodes_are_hashed(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text("/**: {ros__parameters: {gain: 1}}\n")
    (tmp_path / "job.yaml").write_text(
        f"nodes: [{{node: 'm:N', parameter_files: [{tmp_path / 'p.yaml'}]}}]\n"
        "stop: {duration: 1s}\n"
    )
    assert "file:p.yaml" in source_files(load_job(tmp_path / "job.yaml"))


def test_files_that_are_typed_are_hashed(tmp_path: Path) -> None:
    (tmp_path / "typed.txt").write_text("start\n")
    (tmp_path / "job.yaml").write_text("nodes: [{main: 'm:main', stdin: typed.txt}]\n")
    assert "file:typed.txt" in source_files(load_job(tmp_path / "job.yaml"))


def test_a_time_zone_that_is_not_pinned_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for names, told in ((("CET", "CEST"), "CET/CEST"), (("JST", "JST"), "JST"), (("UTC",) * 2, "")):
        monkeypatch.setattr(time, "tzname", names)
        assert environment().get("time_zone", "") == told
