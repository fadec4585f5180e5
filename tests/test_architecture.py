"""What must not be imported, seen from outside in fresh processes."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
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
        ("rsltrace.simulation.loop.loop", set()),
        ("rsltrace.trace.model.event", set()),
        ("rsltrace.job", {"ruamel"}),
        ("rsltrace.trace.reader", set()),
        ("rsltrace.trace.writer", {"numpy"}),
    ],
)
def test_layers_load_only_what_they_need(module: str, allowed: set[str]) -> None:
    assert loaded_after(f"import {module}") <= allowed


def test_the_first_screen_needs_no_conditions_bags_or_latencies() -> None:
    code = (
        "import sys, rsltrace_viewer.terminal.app\n"
        "late = 'conditions.text evaluate latency metrics properties'.split()\n"
        "late = ['rsltrace.trace.recordings', *(f'rsltrace.checks.{name}' for name in late)]\n"
        "print(*[name for name in late if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


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

    for file in (callers._CALLS_BACK, callers._THREADS, *callers._REPLACEMENTS):
        assert Path(file).is_file()
    assert Path(callers._ADAPTER).is_dir()


_parse: Callable[[str], ast.Module] = cache(ast.parse)  # several tests read all modules


def dotted(node: ast.expr) -> str:
    """Return names joined by dots, "" for what is more than names."""
    if isinstance(node, ast.Attribute):
        owner = dotted(node.value)
        return owner and f"{owner}.{node.attr}"
    return getattr(node, "id", "")


def parsed() -> dict[str, ast.Module]:
    """Return the product's modules by their paths."""
    root = Path(__file__).parents[1]
    return {
        str(path.relative_to(root)): _parse(path.read_text(encoding="utf-8"))
        for folder in ("rsltrace", "viewer")
        for path in (root / folder).rglob("*.py")
    }


def method_names(modules: Iterable[ast.Module]) -> set[str]:
    """Return the names of all methods, but not of properties."""
    return {
        one.name
        for module in modules
        for kind in ast.walk(module)
        if isinstance(kind, ast.ClassDef)
        for one in kind.body
        if isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef))
        if not any("property" in ast.unparse(d) or "setter" in ast.unparse(d)
                   for d in one.decorator_list)
    }  # fmt: skip


def data_names(modules: Iterable[ast.Module]) -> set[str]:
    """Return the names of fields, of properties, and of what objects set of their own."""
    nodes = [node for module in modules for node in ast.walk(module)]
    fields = {
        one.target.id
        for kind in nodes
        if isinstance(kind, ast.ClassDef)
        for one in kind.body
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
    }
    properties = {
        one.name
        for one in nodes
        if isinstance(one, ast.FunctionDef)
        if any("property" in ast.unparse(decorator) for decorator in one.decorator_list)
    }
    own = {
        attribute
        for node in nodes
        for owner, attribute, _ in assigned(node)
        if isinstance(owner, ast.Name) and owner.id == "self"
    }
    slots = {
        text
        for kind in nodes
        if isinstance(kind, ast.Assign) and dotted(kind.targets[0]) == "__slots__"
        for text in ast.literal_eval(kind.value)
    }
    return fields | properties | own | slots


def assigned(node: ast.AST) -> Iterator[tuple[ast.expr, str, ast.expr]]:
    """Yield object, attribute and value of each attribute that a statement sets."""
    if isinstance(node, ast.Call) and dotted(node.func).endswith("setattr"):
        if len(node.args) == 3 and isinstance(node.args[1], ast.Constant):
            yield node.args[0], str(node.args[1].value), node.args[2]
        return
    targets: list[tuple[ast.expr, ast.expr]] = []
    if isinstance(node, ast.Assign):
        targets = [(target, node.value) for target in node.targets]
    elif isinstance(node, ast.AnnAssign) and node.value is not None:
        targets = [(node.target, node.value)]
    while targets:
        target, value = targets.pop()
        if isinstance(target, (ast.Tuple, ast.List)):
            same = isinstance(value, (ast.Tuple, ast.List)) and len(value.elts) == len(target.elts)
            values = value.elts if same else [value] * len(target.elts)  # type: ignore[attr-defined]
            targets += zip(target.elts, values, strict=True)
        elif isinstance(target, ast.Attribute):
            yield target.value, target.attr, value


def replaced_methods(modules: dict[str, ast.Module]) -> set[tuple[str, str]]:
    """Return file and method wherever a function takes the place of a method of another object."""
    methods = method_names(modules.values())
    callables = methods - data_names(modules.values())
    found = set()
    for file, module in modules.items():
        functions = [n for n in ast.walk(module) if isinstance(n, (ast.FunctionDef, ast.Lambda))]
        names = {one.name for one in functions if isinstance(one, ast.FunctionDef)}
        for node in ast.walk(module):
            for owner, attribute, value in assigned(node):
                is_function = (
                    attribute in callables
                    or isinstance(value, ast.Lambda)
                    or (isinstance(value, ast.Name) and value.id in names)
                    or (isinstance(value, ast.Attribute) and value.attr in callables)
                    or (isinstance(value, ast.Call) and "partial" in ast.unparse(value.func))
                )
                own = isinstance(owner, ast.Name) and owner.id == "self"
                if is_function and attribute in methods and not own:
                    found.add((file, attribute))
    return found


_NO_METHODS_OF_OURS = {
    ("rsltrace/run/session.py", "note_answer"): "a hook of ProcessAdapter: the guard is made later",
    ("rsltrace/adapters/rclpy/boundary/installation.py", "publish"): "of rclpy's Publisher",
    ("rsltrace/adapters/rclpy/concurrency/asyncio_loops.py", "step"): "a slot of RecordedPoll",
    ("rsltrace/adapters/rclpy/handles/logs.py", "_line"): "a field of a message",
    ("rsltrace/adapters/rclpy/concurrency/mains.py", "register"): "of the module atexit",
    ("rsltrace/adapters/rclpy/concurrency/mains.py", "unregister"): "of the module atexit",
    ("rsltrace/adapters/rclpy/concurrency/threads.py", "__init__"): "of the user's thread classes",
    ("rsltrace/adapters/rclpy/concurrency/threads.py", "__hash__"): "of the user's thread classes",
    ("rsltrace/simulation/middleware/events/dispatcher.py", "entity"): "a field of Event",
}
"""What has the name of a method, and why it is none of the product's objects'."""


@pytest.mark.long
def test_no_method_of_another_object_is_replaced() -> None:
    """Whoever watches or steers a run is an observer (``middleware/events/observer.py``)."""
    modules = parsed()
    found = replaced_methods(modules)
    assert found <= set(_NO_METHODS_OF_OURS), sorted(found - set(_NO_METHODS_OF_OURS))
    assert found >= set(_NO_METHODS_OF_OURS), "no longer there: take it out of the list"
    root = Path(__file__).parents[1]
    assert not [file for file in modules if "method-assign" in (root / file).read_text("utf-8")]


@pytest.mark.parametrize(
    "code",
    [
        "dispatcher.end_event = self.after",
        "a, dispatcher.end_event = 1, lambda: None",
        "setattr(dispatcher, 'end_event', partial(print, 1))",
        "def ended(): ...\ndispatcher.end_event = ended",
    ],
)
def test_a_replaced_method_is_found(code: str) -> None:
    ours = "class Dispatcher:\n  def end_event(self): ...\n  def after(self): ...\n"
    assert replaced_methods({"a.py": ast.parse(ours), "b.py": ast.parse(code)}) == {
        ("b.py", "end_event")
    }


RUNS_CODE = {
    # Modules of a fixed list of ours, or libraries, by names that stand in the source.
    "rsltrace/__init__.py": "import_module",  # public names, when they are first used
    "rsltrace/cli/main.py": "import_module",  # the module of a command
    "rsltrace/compiled.py": "import_module",  # our own in C
    "rsltrace/job/__init__.py": "import_module",  # public names of jobs
    "rsltrace/job/parts/keys.py": "import_module",  # parts of jobs, when a job has them
    "rsltrace/debug/simulation.py": "import_module",  # rclpy, before the first run
    "rsltrace/adapters/rclpy/boundary/installation.py": "exec_module import_module",  # of rosidl
    "rsltrace/adapters/rclpy/executors/user_executors.py": "import_module",  # functions of rclpy
    "rsltrace/adapters/rclpy/parameter_overrides.py": "yaml",  # its parser's events, no objects
    "rsltrace/run/provenance.py": "yaml",  # the same
    "rsltrace/guard/pin.py": "import_module",  # threadpoolctl
    "rsltrace/adapters/workspace/build_files.py": "compile exec import_module",  # setup.py
    # What a run, and only a run, does with code that its job names.
    "rsltrace/adapters/rclpy/messages/interface_classes.py": "import_module",  # classes of messages
    "rsltrace/adapters/rclpy/messages/source_text.py": "compile exec",  # codecs
    "rsltrace/search/explore/worker.py": "import_module",  # what the last run has imported
    "rsltrace/guard/loading.py": "exec_module",  # what an import loads, and is patched
    "rsltrace/guard/virtual/original_code.py": "compile",  # user modules, as they were written
    "rsltrace/guard/virtual/user_modules.py": "compile exec_module",  # the same, with our calls
    "rsltrace/guard/virtual/set_order.py": "pickle",  # makes its pickles of sets ordered
    "rsltrace/adapters/workspace/imports.py": "import_module",  # interfaces that were just made
    "rsltrace/run/plans/executables.py": "exec import_module",  # main: a program, or a function
    "rsltrace/run/plans/scheduling.py": "import_module",  # node: module:Class
    "rsltrace/child_processes.py": "runpy",  # a command of ours, in a process
    # Python launch files are programs; they are read in a process of their own.
    "rsltrace/adapters/launch/python_file.py": "import_module",  # modules of launch
    "rsltrace/adapters/launch/api/substitutions.py": "eval import_module",  # PythonExpression
    "rsltrace/adapters/launch/api/actions.py": "exec_module",  # a Python launch file
    "rsltrace/adapters/launch/expand.py": "pickle",  # the answer of that process
    # Between processes of one command, on a socket or pipe that nobody else has.
    "rsltrace/native/processes/wire.py": "pickle",  # of user code: plain values only
    "rsltrace/run/forked.py": "pickle",  # what a copy of the simulation returns
    "rsltrace/fast_dataclass.py": "exec",  # a function of so many arguments, its text our own
    # Who sits at the prompt of a session, in a run whose code they have agreed to run.
    "rsltrace/debug/inspection.py": "compile eval",
}
"""The modules that turn text into code, or could, with what they use and why they may.

None of them is reached by what a trace, a bag or a parameter file says, unless a run was asked for
(docs/trust.md). Before you add one: expressions have a language (``rsltrace.checks.conditions``),
data has JSON or CDR.
"""
_CALLS = {
    *("eval", "exec", "compile", "__import__", "import_module", "run_module", "run_path"),
    *("exec_module", "load_module"),
}
_MODULES = set(
    "pickle marshal shelve dill cloudpickle jsonpickle runpy imp code codeop yaml".split()
)
_SHELLS = {
    *("os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput"),
    "asyncio.create_subprocess_shell",
}


class _CodeFinder(ast.NodeVisitor):
    """Collects what a module uses that turns text into code."""

    def __init__(self) -> None:
        self.found: set[str] = set()

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func
        name = called.id if isinstance(called, ast.Name) else getattr(called, "attr", "")
        owner = called.value if isinstance(called, ast.Attribute) else None
        is_ours = name == "compile" and owner is not None and ast.unparse(owner) != "builtins"
        if name in _CALLS and not is_ours:
            self.found.add(name)
        words = {one.arg: one.value for one in node.keywords}
        if dotted(called) in _SHELLS:
            self.found.add(dotted(called))
        if isinstance(words.get("shell"), ast.Constant) and words["shell"].value:  # type: ignore[attr-defined]
            self.found.add("shell=True")
        if isinstance(words.get("allow_pickle"), ast.Constant):
            self.found.add("allow_pickle")
        if name == "YAML" and getattr(words.get("typ"), "value", "") in ("unsafe", "full"):
            self.found.add("unsafe YAML")
        self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        self.found |= {one.name.partition(".")[0] for one in node.names} & _MODULES

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        module = (node.module or "").partition(".")[0]
        if not node.level and module in _MODULES:
            self.found.add(module)


def _has(source: str, names: Iterable[str]) -> bool:
    """Return whether a module has one of the names, or the last part of one, as a word."""
    return bool({name.rpartition(".")[2] for name in names}.intersection(_WORD.findall(source)))


_WORD = re.compile(r"\w+")


def _turns_into_code(source: str) -> set[str]:
    finder = _CodeFinder()
    if not _has(source, {*_CALLS, *_MODULES, *_SHELLS, "shell", "allow_pickle", "YAML"}):
        return finder.found
    finder.visit(_parse(source))
    for text in re.findall(r"^import ([\w, ]+)$", source, re.M):  # in programs that are texts here
        finder.found |= {one.strip().split(" ")[0] for one in text.split(",")} & _MODULES
    return finder.found


def test_text_becomes_code_only_where_that_is_meant() -> None:
    """A trace, a bag or a job may come from anybody: what they say is read, never run."""
    root = Path(__file__).parents[1]
    found = {}
    for folder in ("rsltrace", "viewer"):
        for path in (root / folder).rglob("*.py"):
            used = _turns_into_code(path.read_text(encoding="utf-8"))
            if used:
                found[str(path.relative_to(root))] = used
    new = {
        file: sorted(used - set(RUNS_CODE.get(file, "").split()))
        for file, used in found.items()
        if used - set(RUNS_CODE.get(file, "").split())
    }
    assert not new, "these turn text into code: mend them, or say in RUNS_CODE why they may"
    assert RUNS_CODE.keys() <= found.keys(), "what no module does any more goes from the list"


_WRITES_FILES = {
    *("write_text", "write_bytes", "unlink", "rename", "mkdir", "makedirs", "touch", "rmdir"),
    *("symlink_to", "hardlink_to", "rmtree", "copyfile", "copy2", "copytree", "mkfifo"),
    *("os.replace", "os.remove", "os.symlink", "os.link", "os.truncate", "shutil.move"),
}
_OPENS_PORTS = {
    *("socket.socket", "create_server", "create_connection", "start_server", "open_connection"),
    *("TCPServer", "HTTPServer", "ThreadingHTTPServer", "debugpy.listen"),
}


def _opens_for_others(source: str) -> set[str]:
    """Return what a module uses that changes files, or opens sockets."""
    found: set[str] = set()
    if not _has(source, {*_WRITES_FILES, *_OPENS_PORTS, "open", "fdopen"}):
        return found
    for node in ast.walk(_parse(source)):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        name = getattr(called, "attr", getattr(called, "id", ""))
        if isinstance(called, ast.Attribute) or name.endswith("Server"):
            found |= {name, dotted(called)} & (_WRITES_FILES | _OPENS_PORTS)
        modes = [*node.args[:2], *(w.value for w in node.keywords if w.arg in ("mode", "flags"))]
        if name in ("open", "fdopen") and any(map(_is_for_writing, modes)):
            found.add("open")
    return found


def _is_for_writing(mode: ast.expr) -> bool:
    if isinstance(mode, ast.Constant):
        return isinstance(mode.value, str) and bool(re.fullmatch("[rbt+]*[wax+][bt+]*", mode.value))
    return bool(re.search("O_WRONLY|O_RDWR|O_CREAT|FLAGS", ast.unparse(mode)))


WRITES = {
    # Files that the command line, or the call of an API, names.
    "rsltrace/cli/fit.py": "mkdir unlink write_bytes",
    "rsltrace/cli/explore.py": "write_text",
    "rsltrace/cli/output/text_file.py": "open write_text",
    "rsltrace/cli/verify.py": "mkdir shutil.move unlink",
    "rsltrace/debug/client.py": "copyfile unlink",  # a branch; a copy in a folder of our own
    "rsltrace/search/explore/table.py": "mkdir os.truncate rmtree unlink write_text",
    "rsltrace/search/history/run_record.py": "mkdir open",
    "rsltrace/testing/golden.py": "copyfile mkdir unlink",
    "rsltrace/trace/exports/layout.py": "open",
    "rsltrace/trace/exports/perfetto.py": "open",
    "rsltrace/trace/mcap/sink.py": "os.replace os.truncate unlink",
    "rsltrace/trace/model/regular_file.py": "unlink",  # what was begun of such a file
    "rsltrace/trace/recordings/export.py": "mkdir open rename rmtree write_text",
    "viewer/rsltrace_viewer/rerun_export/export.py": "open",
    # Files in folders of our own, and of the cache; traces there have numbers.
    "rsltrace/adapters/launch/expand.py": "open rename write_bytes",
    "rsltrace/adapters/launch/ros_launch.py": "unlink",
    "rsltrace/adapters/processes/build.py": "rmtree write_text",
    "rsltrace/adapters/workspace/cache.py": "mkdir open rename rmtree unlink",
    "rsltrace/adapters/workspace/generate.py": "mkdir os.replace rmtree write_bytes write_text",
    "rsltrace/adapters/workspace/installs.py": "mkdir symlink_to touch",
    "rsltrace/adapters/workspace/interfaces.py": "mkdir touch write_text",
    "rsltrace/cli/bisect.py": "copyfile mkdir",
    "rsltrace/native/processes/record_file.py": "open unlink",
    "rsltrace/native/processes/run.py": "mkdir",
    "rsltrace/replay/replaying.py": "unlink",
    "rsltrace/search/bisect/repository.py": "mkdir symlink_to",  # names in a commit of git
    "rsltrace/search/bisect/search.py": "mkdir",
    "rsltrace/search/explore/cluster.py": "mkdir rmtree symlink_to unlink write_bytes",
    "rsltrace/search/explore/outcome.py": "unlink",
    "rsltrace/search/explore/search.py": "unlink",
    "rsltrace/search/explore/small/causes.py": "mkdir unlink write_text",
    "rsltrace/search/explore/small/reduction.py": "unlink",
    "rsltrace/search/perturb.py": "mkdir symlink_to",
    "rsltrace/search/verify.py": "unlink",
    "rsltrace/trace/recordings/reader.py": "open",  # an unpacked file of a bag
    # Where Python packages are, under the names in wheels of the package index.
    "rsltrace/cli/install_ros.py": "mkdir write_bytes write_text",
    # Nowhere.
    "rsltrace/adapters/rclpy/terminals.py": "open",
    "rsltrace/cli/output/exit_status.py": "open",
    "rsltrace/search/explore/prefix.py": "open",
    # Sockets between processes of one command, or only on this machine.
    "rsltrace/debug/callback_pdb.py": "socket.socket",
    "rsltrace/debug/debuggers.py": "debugpy.listen",
    "rsltrace/debug/prompt/command_table.py": "socket.socket",
    "rsltrace/debug/simulation.py": "socket.socket",
    "rsltrace/debug/supervisor.py": "socket.socket",
    "rsltrace/debug/tree.py": "socket.socket",
    "rsltrace/forking.py": "socket.socket",
    "rsltrace/line_protocol.py": "socket.socket",
    "rsltrace/native/processes/child.py": "socket.socket",
    "rsltrace/native/support.py": "socket.socket",  # is a DDS domain in use?
    "rsltrace/search/explore/worker.py": "open socket.socket",
    "viewer/rsltrace_viewer/rerun_export/control.py": "create_connection socket.socket",
    "viewer/rsltrace_viewer/rerun_export/show.py": "create_connection",
}
"""The modules that change files or open sockets, with what they use and who names the file.

No text of a trace, a bag or a server is the name of a file or an address (docs/trust.md). Before
you add one: write a file that the user names by ``cli.output.text_file``, a trace by its writer.
"""


def test_files_are_written_and_ports_opened_only_where_that_is_meant() -> None:
    """A trace, a bag or a job may come from anybody: what they say names no file to be written."""
    root = Path(__file__).parents[1]
    found = {}
    for folder in ("rsltrace", "viewer"):
        for path in (root / folder).rglob("*.py"):
            if used := _opens_for_others(path.read_text(encoding="utf-8")):
                found[str(path.relative_to(root))] = used
    new = {file: used - set(WRITES.get(file, "").split()) for file, used in found.items()}
    assert not any(new.values()), f"these write files or open ports: mend them, or list them: {new}"
    assert WRITES.keys() <= found.keys(), "what no module does any more goes from the list"


@pytest.mark.parametrize(
    "source",
    [
        "open(name, 'w')",
        "path.open(mode='ab')",
        "os.open(name, os.O_RDWR | os.O_CREAT)",
        "path.write_text(text)",
        "shutil.rmtree(name)",
        "socket.socket()",
        "asyncio.start_server(handle, host, port)",
        "ThreadingHTTPServer(address, Handler)",
    ],
)
def test_what_writes_files_or_opens_ports_is_found(source: str) -> None:
    assert _opens_for_others(source)


_MARKUP = {"from_markup", "Template"}


def _formats_of_others(source: str) -> list[str]:
    """Return formats that are no texts or constants of the module, and what reads markup."""
    found: list[str] = []
    if not _has(source, {*_MARKUP, "format", "format_map"}):
        return found
    tree = _parse(source)
    texts = {
        name.id
        for node in ast.walk(tree)
        if isinstance(node, ast.For)
        and not any(isinstance(one, (ast.Call, ast.Attribute)) for one in ast.walk(node.iter))
        for name in ast.walk(node.target)
        if isinstance(name, ast.Name)
    }
    """Those that a loop takes out of a literal."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if (called.id if isinstance(called, ast.Name) else getattr(called, "attr", "")) in _MARKUP:
            found.append(ast.unparse(called))
        if not isinstance(called, ast.Attribute) or called.attr not in ("format", "format_map"):
            continue
        text = called.value
        while isinstance(text, ast.Subscript):
            text = text.value
        name = getattr(text, "id", "")
        if not (isinstance(text, ast.Constant) or name.isupper() or name in texts):
            found.append(ast.unparse(called))
    return found


_FORMATS = {
    "rsltrace/simulation/middleware/events/failure.py": "summary.format",  # of a traceback
    "rsltrace/adapters/rclpy/messages/decoder_source.py": "conversion.format",  # of a table there
}


def test_formats_are_texts_of_ours() -> None:
    """A format can read attributes (``{0.__class__}``), and markup can show what is not there."""
    root = Path(__file__).parents[1]
    for folder in ("rsltrace", "viewer"):
        for path in (root / folder).rglob("*.py"):
            file = str(path.relative_to(root))
            found = set(_formats_of_others(path.read_text(encoding="utf-8")))
            assert found <= set(_FORMATS.get(file, "").split()), file


@pytest.mark.parametrize(
    "source", ["text.format(1)", "a.text.format_map(b)", "Text.from_markup(a)"]
)
def test_a_format_of_somebody_else_is_found(source: str) -> None:
    assert _formats_of_others(source)


@pytest.mark.parametrize(
    "source",
    [
        "eval(text)",
        "builtins.exec(text)",
        "compile(tree, 'x', 'eval')",
        "import pickle",
        "import yaml",
        "asyncio.create_subprocess_shell(text)",
        "from pickle import loads",
        "__import__(name)",
        "importlib.import_module(name)",
        "subprocess.run(words, shell=True)",
        "os.system(text)",
        "numpy.load(path, allow_pickle=True)",
        "YAML(typ='unsafe')",
    ],
)
def test_what_turns_text_into_code_is_found(source: str) -> None:
    assert _turns_into_code(source)


def test_the_language_of_conditions_runs_nothing() -> None:
    """It has neither a way to run code nor the modules that could."""
    root = Path(__file__).parents[1] / "rsltrace/checks/conditions"
    assert not any(_turns_into_code(path.read_text("utf-8")) for path in root.glob("*.py"))
