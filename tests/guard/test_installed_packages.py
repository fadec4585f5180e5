"""The user's packages are the user's wherever they are installed; how they came there tells."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rsltrace.guard import libraries
from rsltrace.guard.callers import is_user_file
from rsltrace.guard.object_numbers import ObjectNumbers
from rsltrace.trace.model.finding import NondeterminismSource
from tests.guard.conftest import list_as_wheel, node_code

pytestmark = pytest.mark.ros

HELPER = """
class Thing:
    def __init__(self, name):
        self.name = name

class Registry:
    def __init__(self):
        self.things = set()

    def add(self, *names):
        self.things |= {Thing(name) for name in names}

    def all(self):
        return list(self.things)
"""
TICK = """
registry = Registry()
registry.add('delta', 'alpha', 'echo', 'bravo', 'charlie')
first = [thing.name for thing in registry.all()]
registry.add('aachen', 'zagreb')
self.say(first, [thing.name for thing in registry.all()])
"""
ALIKE = "registry = Registry()\nregistry.add('same', 'same')\nregistry.all()"


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    (folder / name).mkdir(parents=True)
    (folder / name / "__init__.py").write_text(HELPER)
    monkeypatch.syspath_prepend(str(folder))


@pytest.mark.long
@pytest.mark.parametrize(
    "place", ["install/helper_a/lib/python3.12/site-packages", "venv/dist-packages", "src/beside"]
)
def test_objects_of_an_installed_package_are_in_order(
    place: str, said: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "helper_" + place.replace("/", "_").replace(".", "_").replace("-", "_")
    install(tmp_path / place, monkeypatch, name)
    (first, later), (again, _) = said(node_code(TICK, imports=f"from {name} import Registry"))
    assert first == again == ["alpha", "bravo", "charlie", "delta", "echo"]
    assert later == [*first, "aachen", "zagreb"]  # who has a place keeps it
    assert "__pycache__" not in {path.name for path in (tmp_path / place / name).iterdir()}


@pytest.mark.long
def test_what_cannot_be_put_in_order_is_found_at_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rsltrace.job import load_job
    from rsltrace.run import record
    from rsltrace.trace.reader import Trace

    install(tmp_path / "site-packages", monkeypatch, "helper_alike")
    (tmp_path / "m.py").write_text(node_code(ALIKE, imports="from helper_alike import Registry"))
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 0.7s}\n")
    record(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        (found,) = [one for many in trace.findings.values() for one in many]
    line = 1 + HELPER.splitlines().index("        return list(self.things)")
    assert found.source is NondeterminismSource.ORDER
    assert found.call == "order of a set of Thing"
    assert found.stack.startswith(f"helper_alike/__init__.py:{line} in")


def test_a_package_with_a_finder_of_its_own(
    said: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As setuptools installs editable packages."""
    import importlib.util

    file = tmp_path / "elsewhere" / "code.py"
    file.parent.mkdir()
    file.write_text(HELPER)

    class Finder:
        @staticmethod
        def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
            found = name == "helper_editable"
            return importlib.util.spec_from_file_location(name, file) if found else None

    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder])
    monkeypatch.delitem(sys.modules, "helper_editable", raising=False)
    said_ = said(node_code(TICK, imports="from helper_editable import Registry"))
    assert said_[0][0] == ["alpha", "bravo", "charlie", "delta", "echo"]


_MARKER = "../../../share/ament_index/resource_index/packages/"
_FOLDER = json.dumps({"url": "file:///home/me/src", "dir_info": {}})
_ARCHIVE = json.dumps({"url": "file:///home/me/x.whl", "archive_info": {}})
WAYS = {
    "a wheel": ("numpydantic", {}, True),
    "a wheel of another name": ("cv2", {"distribution": "opencv_python"}, True),
    "a wheel that begins as ROS does": ("rclpy_utils", {}, True),
    "a wheel of the user's own disk": ("helper", {"direct_url": _ARCHIVE}, True),
    "a wheel of ROS": (
        "tf2_web",
        {"distribution": "ros_tf2_web", "record": f"{_MARKER}tf2_web,,\n"},
        True,
    ),
    "conda": ("scikits", {"installer": "conda", "direct_url": _FOLDER}, True),
    "a folder": ("my_robot", {"direct_url": _FOLDER}, False),
    "a wheel of a package of ROS": (
        "ros2_planner",
        {"record": f"{_MARKER}ros2_planner,,\n"},
        False,
    ),
    "of ROS by its name only": ("ros_arm", {"record": f"{_MARKER}ros_arm,,\n"}, False),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("site", ["venv/lib/python3.11/site-packages", "usr/local/dist-packages"])
def test_how_a_package_was_installed_tells_whose_it_is(tmp_path: Path, way: str, site: str) -> None:
    name, more, is_library = WAYS[way]
    folder = tmp_path / site
    (folder / name).mkdir(parents=True)
    list_as_wheel(folder, name, **more)
    list_as_wheel(folder, "another", "opencv")
    assert is_user_file(str(folder / name / "node.py")) != is_library
    assert is_user_file(str(folder / "another.py")) is False
    assert is_user_file(str(folder / "unlisted" / "node.py"))


@pytest.mark.parametrize("name", ["ros2_planner", "launch_robot", "rclpy_utils", "rqt_mine"])
def test_what_colcon_has_installed_is_the_users(name: str) -> None:
    assert is_user_file(f"/ws/install/{name}/lib/python3.12/site-packages/{name}/node.py")


def test_who_is_a_library() -> None:
    for file in (
        "/ws/install/my_robot/lib/python3.12/site-packages/my_robot/node.py",
        "/home/me/src/my_robot/node.py",
    ):
        assert is_user_file(file), file
    for file in (
        "/opt/ros/jazzy/lib/python3.12/site-packages/anything/x.py",
        "/usr/lib/python3/dist-packages/helper.py",
        "/ros/install/rosidl_parser/lib/python3.12/site-packages/rosidl_parser/x.py",
        "/ws/install/my_msgs/lib/python3.12/site-packages/my_msgs/msg/_thing.py",
        sys.modules["json"].__file__,
        *(sys.modules[name].__file__ for name in ("numpy", "_pytest", "yaml", "rclpy", "click")),
    ):
        assert file is not None
        assert not is_user_file(file), file


def test_a_node_may_replace_open(monkeypatch: pytest.MonkeyPatch) -> None:
    libraries._is_library.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr("builtins.open", None)
        folder = Path(pytest.__file__).parents[1]
        assert libraries.is_library(str(folder / "pytest" / "__init__.py"))


@pytest.mark.long
def test_packages_that_pip_has_installed(tmp_path: Path) -> None:
    """A wheel in a folder (``--target``), the sources in another, and an editable package."""
    pytest.importorskip("setuptools", minversion="71", reason="needs setuptools")
    source = tmp_path / "source"
    (source / "planner_of_mine").mkdir(parents=True)
    (source / "planner_of_mine" / "__init__.py").write_text("")
    (source / "pyproject.toml").write_text(
        '[project]\nname = "planner-of-mine"\nversion = "1.0"\n'
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
    )
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    no_index = ["--no-build-isolation", "--no-deps", "--no-index"]
    wheels = tmp_path / "wheels"
    subprocess.run([*pip, "wheel", *no_index, "-w", wheels, source], check=True, timeout=300)
    (wheel,) = wheels.glob("*.whl")
    for what, is_users in (([wheel], False), ([source], True), (["-e", source], True)):
        target = tmp_path / ("site-packages" + str(len(what)) + str(is_users)) / "site-packages"
        subprocess.run(
            [*pip, "install", *no_index, "--target", target, *what], check=True, timeout=300
        )
        probe = f"import sys; sys.path.insert(0, {str(target)!r}); import site\n"
        probe += f"site.addsitedir({str(target)!r})\nimport planner_of_mine as p\n"
        probe += "from rsltrace.guard.callers import is_user_file\nprint(is_user_file(p.__file__))"
        done = subprocess.run(
            [sys.executable, "-c", probe], capture_output=True, text=True, check=True, timeout=300
        )
        assert done.stdout.strip() == str(is_users), what


def method_of(name: str) -> Callable[[], str]:
    return lambda: name


@pytest.mark.long
def test_numbers_are_kept_for_as_long_as_an_object_lives() -> None:
    class Thing:
        def __init__(self, name: str, other: object = None) -> None:
            self.name, self.other = name, other

    numbers = ObjectNumbers()
    a, b = Thing("b"), Thing("a")
    assert numbers.in_order([a, b]) == [b, a] == numbers.in_order([b, a])
    b.name = "z"
    assert numbers.in_order([a, b]) == [b, a]
    assert numbers.in_order([Thing("x", b), Thing("x", a)]) is not None  # told apart by those
    assert numbers.in_order([Thing("same"), Thing("same")]) is None
    circle = Thing("circle")
    circle.other = circle
    assert numbers.in_order([circle, a, 3, "text"]) is not None
    made = [lambda n=n: n for n in "cab"] + [partial(print, n) for n in "ed"]
    made += [method_of(name) for name in "gf"]
    in_order = numbers.in_order(made)
    assert in_order == [made[n] for n in (6, 5, 1, 2, 0, 4, 3)]  # told apart by what they hold
    del made, in_order
    del a, b, circle
    gc.collect()
    assert not numbers._kept


DATACLASSES = """
@dataclasses.dataclass(frozen=True)
class Key:
    owner: object
    number: int

@dataclasses.dataclass(frozen=True)
class Plain:
    number: float
"""
KEYS = """
keys = {Key(Owner(), number) for number in range(50)} | {Key(None, 50)}
self.say([key.number for key in keys])
self.say(len({Plain(number / 2) for number in range(3)}))
"""


def test_what_a_hash_method_does_is_no_finding_and_its_objects_are_in_order(tmp_path: Path) -> None:
    """Natively the order goes by the addresses of the owners (and of None before Python 3.12)."""
    from rsltrace.job import load_job
    from rsltrace.run import record
    from rsltrace.trace.reader import Trace

    code = node_code(KEYS, imports="import dataclasses", module=DATACLASSES + "class Owner: pass")
    (tmp_path / "m.py").write_text(code)
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 0.7s}\n")
    result = record(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    numbers = json.loads(texts[0])[0]
    assert numbers == sorted(range(51), key=lambda number: f"{number},")
    assert {(met.call, met.mode.value) for met in result.guarded} == {("order of a set", "virtual")}


TESTS = """
class Thing:
    def __init__(self, number):
        self.number = number

def test_order():
    things = {Thing(number) for number in range(100)}
    print([thing.number for thing in things])
    assert len(things) == 100
"""


@pytest.mark.long
def test_modules_that_pytest_compiles(
    tmp_path: Path, capfd: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)  # of the run that this test is in
    (tmp_path / "test_things.py").write_text(TESTS)
    words = "[-q, -s, -p, 'no:cacheprovider', --rootdir=., test_things.py]"
    (tmp_path / "job.yaml").write_text(
        f"nodes: [{{main: 'pytest:console_main', arguments: {words}}}]\n"
    )
    shown = set()
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-m", "rsltrace", "record", "job.yaml", "--no-pin", "-o", "run.mcap",
             "--force"],
            cwd=tmp_path, capture_output=True, text=True, check=True, timeout=300,
        )  # fmt: skip
        assert "1 passed" in done.stdout
        shown.add(next(line for line in done.stdout.splitlines() if line.startswith("[")))
    assert len(shown) == 1
    cached = list(tmp_path.glob("__pycache__/*pytest*"))
    assert not cached, "plain pytest would find our calls there"
