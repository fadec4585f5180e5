"""Which lines of programs are shown as their own code."""

from __future__ import annotations

import re
import struct
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes.build import find_compiler
from rsltrace.adapters.processes.source_lines import callback_place, stack_text
from rsltrace.errors import NodeError, SetupError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.reader import Trace

_long = pytest.mark.long


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("node", "node.c:2"),
        ("python_bridge", "node.c:2"),
        ("python3.11", ""),
        ("libpython3.13t.so.1.0", ""),
        ("lib-dynload/_random.so", ""),
    ],
)
def test_lines_of_an_interpreter_are_not_those_of_its_program(
    tmp_path: Path, name: str, place: str
) -> None:
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    source, program = tmp_path / "node.c", tmp_path / name
    program.parent.mkdir(exist_ok=True)
    source.write_text("\nint main(void) { return 0; }\n")
    subprocess.run([*compiler, "-g", "-x", "c", str(source), "-o", str(program)], check=True)
    assert callback_place("main", [(str(program), 0)]) == place


def test_a_template_of_a_library_is_no_line_of_the_program(tmp_path: Path) -> None:
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    source, program = tmp_path / "node.cpp", tmp_path / "node"
    source.write_text("#include <algorithm>\nint main(int n, char **) { return std::max(n, 2); }\n")
    subprocess.run([*compiler, "-g", "-O0", str(source), "-o", str(program)], check=True)
    said = subprocess.run(["nm", "-C", str(program)], capture_output=True, text=True, check=True)
    texts = {"std::max": "", "main": "node.cpp:2 in main"}
    for name, text in texts.items():
        line = next(one for one in said.stdout.splitlines() if f" {name}" in one)
        path = str(program).encode()
        frame = struct.pack(f"<II{len(path)}sQ", 1, len(path), path, int(line.split()[0], 16))
        assert stack_text(frame) == text


_CRASHES = """
#include <csignal>
#include <stdexcept>
#include <unistd.h>
volatile int *nowhere;
int deeper(int n) {
  volatile char room[4096] = {};
  return deeper(n + 1) + room[n % 4096];
}
void crash(const std::string &how) {
  if (how == "fault") *nowhere = 1;
  if (how == "throw") throw std::runtime_error("wheel lost");
  if (how == "recursion") deeper(0);
  std::signal(SIGINT, [](int) {});
  sleep(9);
  *nowhere = 1;
}
int main(int, char **words) { crash(words[1]); }
"""


def _crashing(folder: Path) -> str:
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    (folder / "robot.cpp").write_text(_CRASHES)
    words = ["-g", str(folder / "robot.cpp"), "-o", str(folder / "robot")]
    subprocess.run([*compiler, *words], check=True)
    return "robot"


@pytest.mark.parametrize(
    ("how", "line"), [("fault", 11), ("throw", 12), pytest.param("recursion", 6, marks=_long)]
)
def test_a_process_that_crashes_is_reported_with_its_lines(
    tmp_path: Path, how: str, line: int
) -> None:
    _crashing(tmp_path)
    job = f"nodes: [{{program: robot, arguments: [{how}]}}]\nstop: {{duration: 1s}}\n"
    (tmp_path / "job.yaml").write_text(job)
    error = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap").error
    assert isinstance(error, NodeError)
    head, *frames = error.traceback_text.splitlines()
    assert head == "Traceback (most recent call last):"
    assert re.fullmatch(rf'  File "robot.cpp", line {line}, in \w+\(.*\)', frames[-1])
    if how != "recursion":
        assert frames[0] == '  File "robot.cpp", line 18, in main'
    with Trace.open(tmp_path / "t.mcap") as trace:
        raised = [o for o in trace.outputs_of(0) if o.kind is OutputKind.EXCEPTION]
        assert (trace.detail(raised[0]) or "").startswith(error.traceback_text)
    (tmp_path / "job.yaml").write_text(job.replace("]}", "], on_exception: log}"))
    notes = run(load_job(tmp_path / "job.yaml"), tmp_path / "u.mcap").notes
    assert any(f"crashed at robot.cpp:{line} in " in note for note in notes)


def test_a_crash_when_the_run_is_over_is_a_note(tmp_path: Path) -> None:
    name = _crashing(tmp_path)
    (tmp_path / "job.yaml").write_text(
        f"nodes: [{{program: {name}, arguments: [late]}}]\nstop: {{duration: 1s}}\n"
    )
    result = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap")
    assert result.error is None
    notes = [note for note in result.notes if "was killed by SIGSEGV when the run was over" in note]
    assert len(notes) == 1
    assert " at robot.cpp:16 in crash(" in notes[0]


_LOADS = """
#include <csignal>
#include <dlfcn.h>
#include <unistd.h>
int gain();
int main() {
  gain();
  std::signal(SIGINT, [](int) {});
  dlopen("libplugin.so", RTLD_NOW);
  sleep(9);
}
"""


def test_libraries_of_a_process_are_part_of_the_code_of_a_run(tmp_path: Path) -> None:
    """Those that it is linked with, and those that it loads itself; none of the system."""
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    for name, text in (("gain", "int gain() { return 1; }"), ("plugin", "int plugin;")):
        (tmp_path / f"{name}.cpp").write_text(text)
        shared = ["-fPIC", "-shared", f"{name}.cpp", "-o", f"lib{name}.so"]
        subprocess.run([*compiler, *shared], check=True, cwd=tmp_path)
    (tmp_path / "robot.cpp").write_text(_LOADS)
    linked = ["robot.cpp", "-L.", "-lgain", "-Wl,-rpath,$ORIGIN", "-ldl", "-o", "robot"]
    subprocess.run([*compiler, *linked], check=True, cwd=tmp_path)
    (tmp_path / "job.yaml").write_text("nodes: [{program: robot}]\nstop: {duration: 1s}\n")
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap").error is None
    with Trace.open(tmp_path / "t.mcap") as trace:
        hashed = {name for name in trace.metadata(METADATA_SOURCES) if ".so" in name}
    assert hashed == {"file:libgain.so", "file:libplugin.so"}
