"""What a command does not load, and that it is there all the same for who asks."""

from __future__ import annotations

import copy
import dataclasses
import gc
import importlib.metadata
import inspect
import pickle
import subprocess
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, ClassVar

import pytest
from click.testing import CliRunner

from rsltrace import fast_dataclass
from rsltrace.cli.main import cli
from rsltrace.run.provenance import _PACKAGES, _versions

_RECORDED = """
import json, sys
from pathlib import Path
import rsltrace

text = "nodes: [{node: rclpy.node:Node, arguments: {node_name: n}}]\\nstop: {duration: 1s}\\n"
Path("job.yaml").write_text(text)
assert rsltrace.record(rsltrace.load_job("job.yaml"), Path("run.mcap")).exit_code == 0
print(json.dumps(sorted(sys.modules)))
import rosidl_generator_py
assert "lark" not in sys.modules
assert callable(rosidl_generator_py.generate_py) and "lark" in sys.modules
"""
_NOT_NEEDED = (
    *("lark", "em", "rosidl_pycommon", "importlib.metadata", "xml.etree.ElementTree"),
    *(
        "pydantic",
        "rosbags",
        "rich",
        "rsltrace.adapters.launch.expand",
        "rsltrace.adapters.launch.model",
        "rsltrace.adapters.workspace.interfaces",
    ),
    *(
        f"rsltrace.job.parts.{part}"
        for part in (
            "bag",
            "check",
            "clocks",
            "delay",
            "distribution",
            "fault",
            "scheduling",
            "vary",
        )
    ),
)


@pytest.mark.ros
def test_a_small_run_loads_no_generators_no_pydantic_and_no_metadata(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _RECORDED], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    loaded = done.stdout.splitlines()[-1]
    assert '"rsltrace.run.session"' in loaded
    assert [name for name in _NOT_NEEDED if f'"{name}"' in loaded] == []


_PARTS_AT_FIRST_USE = """
import sys
import rsltrace

job = rsltrace.Job(nodes=[{"node": "n:N"}], stop={"duration": "1s"})
built = lambda kind: "_fields" in vars(kind)
from rsltrace.job import NodeSpec
from rsltrace.job.parts.process import RespawnSpec
assert built(NodeSpec) and not built(RespawnSpec)
assert "rsltrace.job.parts.delay" not in sys.modules
delayed = rsltrace.Job(nodes=[{"node": "n:N", "start_after": "1s"}], delay={"default": "1ms"})
from rsltrace.job.parts.delay import DelaySpec, DelaysSpec
assert type(delayed.delay) is DelaysSpec and type(delayed.delay.default) is DelaySpec
assert delayed.replace(delay=delayed.delay) == delayed and built(DelaySpec)
"""


def test_parts_of_a_job_are_loaded_and_built_at_first_use() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PARTS_AT_FIRST_USE], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@fast_dataclass.dataclass(frozen=True, slots=True)
class Kept:
    a: int
    b: tuple[int, ...]


@pytest.mark.parametrize("eq", [True, False])
@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize("slots", [True, False])
def test_a_quick_dataclass_is_one_of_pythons(eq: bool, frozen: bool, slots: bool) -> None:
    options = {"eq": eq, "frozen": frozen, "slots": slots}
    annotations = {"a": int, "b": list[int], "c": int}
    for names in (["a", "b", "c"], ["a"], []):
        given = {name: annotations[name] for name in names}
        body = {"__annotations__": given, "c": dataclasses.field(default=3, compare=False)}
        body = body if "c" in names else {"__annotations__": given}
        quick, own = (
            make(**options)(type("Made", (), dict(body)))
            for make in (fast_dataclass.dataclass, dataclasses.dataclass)
        )
        assert (quick.__hash__ is None) is (own.__hash__ is None)
        values = [[1, (2,)], [1, (2,), 4], [2, (2,)]] if len(names) == 3 else [[1], [2]]
        values = values if names else [[]]
        for one in values:
            assert repr(quick(*one)) == repr(own(*one))
            if eq and frozen:
                assert hash(quick(*one)) == hash(own(*one))
            assert quick(*one) != own(*one)
            for other in values:
                assert (quick(*one) == quick(*other)) is (own(*one) == own(*other))
        assert [field.name for field in dataclasses.fields(quick)] == names
        made = quick(*values[0])
        assert hasattr(made, "__dict__") is not slots
        for name in names:
            with pytest.raises(dataclasses.FrozenInstanceError) if frozen else nullcontext():
                setattr(made, name, 0)
            assert (getattr(made, name) == 0) is not frozen
            with pytest.raises(dataclasses.FrozenInstanceError) if frozen else nullcontext():
                delattr(made, name)
        assert (
            pickle.loads(pickle.dumps(Kept(1, (2,)))) == Kept(1, (2,)) == copy.copy(Kept(1, (2,)))
        )


@pytest.mark.parametrize("slots", [True, False])
@pytest.mark.parametrize("given", [(), (1,), (1, 2), (1, 2, 3, 4, 5), {"a": 1, "c": 2, "b": 3}])
def test_a_quick_dataclass_inherits_fields_as_pythons_does(given: Any, slots: bool) -> None:
    def family(decorate: Any) -> list[Any]:
        @decorate(frozen=True, slots=slots)
        class Base:
            a: int
            b: int

            def total(self) -> int:
                return self.a + self.b

        @decorate(frozen=True, slots=slots)
        class Derived(Base):
            """What it is."""

            c: int = 7
            a: str

        @decorate(frozen=True, slots=slots)
        class Empty(Derived):
            pass

        return [Base, Derived, Empty]

    def told(cls: Any) -> Any:
        words = given if isinstance(given, dict) else {}
        try:
            made = cls(*(() if words else given), **words)
        except TypeError as error:
            return str(error)
        fields = [(f.name, f.type, f.default) for f in dataclasses.fields(made)]
        changed = dataclasses.replace(made, b=9)
        with pytest.raises(dataclasses.FrozenInstanceError):
            made.a = 3
        same = (made == cls(**dataclasses.asdict(made)), made == changed, len({made, changed}))
        return (repr(made), repr(changed), fields, same, made.total(), cls.__match_args__)

    quick, own = family(fast_dataclass.dataclass), family(dataclasses.dataclass)
    for one, other in zip(quick, own, strict=True):
        assert told(one) == told(other)
        if slots:
            assert one.__slots__ == list(other.__slots__)
        assert list(inspect.signature(one).parameters) == list(inspect.signature(other).parameters)


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize("slots", [True, False])
def test_a_quick_dataclass_makes_defaults_as_pythons_does(frozen: bool, slots: bool) -> None:
    def make(decorate: Any) -> Any:
        @decorate(frozen=frozen, slots=slots)
        class Made:
            limit: ClassVar[int] = 3

            a: int
            b: list[int] = dataclasses.field(default_factory=list)
            c: int = dataclasses.field(default=5, repr=False)
            d: str = "d"

            def __post_init__(self) -> None:
                self.b.append(self.a + self.limit)

        return Made

    quick, own = make(fast_dataclass.dataclass), make(dataclasses.dataclass)
    assert quick._plain_fields is not None, "this takes Python's way"
    told = [
        [repr(cls(1)), repr(cls(2, [1], d="e")), repr(cls(1)), cls(1).c, cls(1, c=2).c]
        for cls in (quick, own)
    ]
    assert told[0] == told[1]
    assert quick(1) == quick(1) != quick(1, c=2)
    assert quick(1).b is not quick(1).b
    fields = [
        [(f.name, f.default, f.default_factory, f.repr) for f in dataclasses.fields(c)]
        for c in (quick, own)
    ]
    assert fields[0] == fields[1]
    for name in ("a", "b"):
        assert hasattr(quick, name) is hasattr(own, name) is slots
    assert dataclasses.replace(quick(1, [2]), a=7).b == dataclasses.replace(own(1, [2]), a=7).b


def test_versions_are_those_of_the_packages_metadata() -> None:
    known = {}
    for package in _PACKAGES:
        try:
            known[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    assert dict(_versions()) == known
    assert "numpy" in known


@pytest.mark.filterwarnings("ignore:Implicit None:DeprecationWarning")  # from Python 3.12 on
def test_versions_are_found_in_either_kind_of_metadata(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    egg = tmp_path / "rclpy-7.1.6-py3.12.egg-info"
    egg.mkdir()
    (egg / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: rclpy\nVersion: 7.1.6\n\ntext\n")
    (tmp_path / "mcap-1.2.egg-info").write_text("Name: mcap\nVersion: 1.2.post1\n")
    wheel = tmp_path / "numpy-2.0.dist-info"
    wheel.mkdir()
    (wheel / "METADATA").write_text("Name: numpy\nversion: 2.0\n\nVersion: 9\n")
    (tmp_path / "scipy-1.0.dist-info").mkdir()  # left over, with nothing in it
    monkeypatch.setattr(sys, "path", [str(tmp_path / "missing"), str(tmp_path)])
    _versions.cache_clear()
    try:
        found = {}
        for dist in importlib.metadata.distributions():
            with suppress(FileNotFoundError):  # the backport, if it is loaded, raises for scipy's
                found[dist.metadata["Name"]] = dist.version
        assert dict(_versions()) == {"rclpy": "7.1.6", "mcap": "1.2.post1", "numpy": "2.0"}
        assert {k: v for k, v in found.items() if k} == dict(_versions())
    finally:
        _versions.cache_clear()


@pytest.mark.ros
def test_garbage_is_collected_after_a_command_that_was_called(tmp_path: Path) -> None:
    """The process of a command stops looking for garbage; one that calls it goes on."""
    (tmp_path / "talker.py").write_text(
        "from rclpy.node import Node\n\ndef make():\n    return Node('talker')\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: talker:make}]\nstop: {duration: 1ms}\n")
    words = ["record", str(tmp_path / "job.yaml"), "-o", str(tmp_path / "run.mcap"), "--no-pin"]
    assert CliRunner().invoke(cli, words).exit_code == 0
    assert gc.get_freeze_count() < 1000, "what was there before is not left out for ever"
