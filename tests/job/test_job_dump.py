"""A job written out loads as the same job, and its resolved form is the same on every machine."""

from __future__ import annotations

import json
import string
import tempfile
from pathlib import Path
from typing import Any

import jsonschema
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from rsltrace.job import BagSpec, Job, NodeSpec, QosSpec, RecordSpec, StopSpec, TopicStop, load_job
from rsltrace.job.documents.schema import job_schema
from rsltrace.job.parts.clocks import ClockSpec, JumpSpec
from rsltrace.job.parts.distribution import SamplesSpec, SeriesSpec
from tests.tiers import cases

SCHEMA = jsonschema.Draft202012Validator(job_schema())

names = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True)
plain_names = st.from_regex(r"[A-Za-z][A-Za-z0-9]{0,8}", fullmatch=True)
topics = st.lists(names, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
remaps = st.lists(plain_names, min_size=1, max_size=3).map("/".join)
globs = st.lists(st.text(string.printable, max_size=8).map(lambda text: "/" + text), max_size=3)
targets = st.tuples(plain_names, plain_names).map(":".join)
times_ns = st.integers(0, 2**63 - 1)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)
scalars = [st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), texts]
parameters = st.dictionaries(
    st.text(
        st.characters(exclude_categories=["Cs"], exclude_characters="."), min_size=1, max_size=8
    ),
    st.one_of(*scalars, *(st.lists(s, min_size=1, max_size=4) for s in scalars)),
    max_size=4,
).map(lambda values: {k: v for k, v in values.items() if k != "ros__parameters"})
values = st.recursive(
    st.one_of(st.none(), *scalars),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(texts, inner, max_size=3)),
    max_leaves=6,
)
nodes = st.builds(
    NodeSpec,
    node=targets,
    namespace=st.none() | topics,
    parameters=parameters,
    remappings=st.dictionaries(remaps, remaps, max_size=3),
    arguments=st.dictionaries(plain_names, values, max_size=3),
)


def _named(specs: list[NodeSpec]) -> list[NodeSpec]:
    """Give every second node a name of its own."""
    return [s.replace(name=f"n{i}") if i % 2 else s for i, s in enumerate(specs)]


stops = st.builds(
    StopSpec,
    duration_ns=st.none() | times_ns,
    time_ns=st.none() | times_ns,
    events=st.none() | st.integers(1, 2**63 - 1),
    topic=st.none() | st.builds(TopicStop, name=topics, exit_code=st.none() | plain_names),
    function=st.none() | targets,
    quiescence_ns=st.none() | st.integers(1, 2**63 - 1),
    size=st.none() | st.integers(1, 2**63 - 1),
)
bags = st.builds(
    BagSpec,
    path=st.just("bag"),
    topics=globs,
    exclude=globs,
    start_offset_ns=times_ns,
    duration_ns=st.none() | st.integers(1, 2**63 - 1),
    at_ns=st.none() | times_ns,
    rate=st.floats(0, exclude_min=True, allow_nan=False, allow_infinity=False),
    loop=st.just(False) | st.integers(1, 2**63 - 1),
    by=st.sampled_from(["log_time", "publish_time", "header_stamp"]),
    remappings=st.dictionaries(topics, topics, max_size=2),
    qos=st.dictionaries(
        topics,
        st.builds(
            QosSpec,
            reliability=st.sampled_from([None, "reliable", "best_effort"]),
            depth=st.none() | st.integers(1, 2**31 - 1),
        ),
        max_size=2,
    ),
)
short_times = st.integers(0, 2**55).map(lambda ns: f"{ns}ns")
some_times = st.integers(1_000_000, 2**55).map(lambda ns: f"{ns}ns")
signed_times = st.tuples(st.sampled_from(["", "-"]), short_times).map("".join)
shares = st.floats(0, 1)
distributions = st.one_of(
    st.fixed_dictionaries({"constant": short_times}),
    st.fixed_dictionaries(
        {"normal": st.fixed_dictionaries({"mean": short_times, "sd": some_times})}
    ),
    st.lists(short_times, min_size=1, max_size=3).map(lambda v: {"samples": {"values": v}}),
    st.lists(st.integers(0, 2**55), min_size=2, max_size=4).map(
        lambda v: {"empirical": {"values": [f"{ns}ns" for ns in sorted(v)]}}
    ),
    st.just({"empirical": {"values": ["1ms", "1ms", "2ms"], "percent": [0, 99.5, 100]}}),
    st.tuples(some_times, short_times, st.booleans()).map(
        lambda v: {"series": {"points": [["0s", v[1]], [v[0], v[1]]], "steps": v[2]}}
    ),
    st.floats(0.1, 10).map(lambda v: {"lognormal": {"median": "5ms", "sigma": v}}),
    st.floats(0.1, 10).map(lambda v: {"gamma": {"shape": v, "scale": "5ms"}}),
)
models = st.tuples(
    distributions,
    st.fixed_dictionaries(
        {"drop": shares, "keep_order": st.booleans(), "retransmit": some_times},
        optional={"burst": st.fixed_dictionaries({"good_to_bad": shares, "bad_to_good": shares})},
    ),
).map(lambda both: {**both[0], **both[1]})
links = st.tuples(models, topics, topics).map(lambda v: {**v[0], "from": v[1], "topic": v[2]})
outages = st.tuples(some_times, topics).map(lambda v: {"node": v[1], "from": "1us", "to": v[0]})
delays = st.fixed_dictionaries(
    {
        "default": models,
        "topics": st.dictionaries(topics, models, max_size=2),
        "services": st.dictionaries(topics, models, max_size=2),
        "links": st.lists(links, max_size=2),
        "outages": st.lists(outages, max_size=2),
    }
)
executions = st.fixed_dictionaries(
    {"default": distributions, "nodes": st.dictionaries(topics, distributions, max_size=2)}
)
clocks = st.fixed_dictionaries(
    {
        "node": topics,
        "offset": signed_times,
        "drift": st.floats(-1e5, 1e5),
        "jumps": st.lists(
            st.fixed_dictionaries({"at": st.just("1s"), "by": signed_times}), max_size=2
        ),
        "random_jumps": st.fixed_dictionaries({"every": some_times, "most": some_times}),
    }
)
jobs = st.fixed_dictionaries(
    {
        "delay": delays,
        "execution": executions,
        "clocks": st.lists(clocks, max_size=2),
        "min_time_step_ns": times_ns,
        "policy": st.sampled_from(
            ["permutation", {"priority": [{"priority": -3, "group_of": "/a"}]}, {"function": "m:P"}]
        ),
        "executors": st.sampled_from(["per_node", "single_threaded", [{"nodes": ["/a"]}]]),
        "nodes": st.lists(nodes, min_size=1, max_size=3).map(_named),
        "stop": stops,
        "bags": st.lists(bags, max_size=2),
        "record": st.builds(
            RecordSpec,
            payloads=st.booleans(),
            topics=globs.filter(bool),
            exclude=globs,
            segment_events=st.integers(1, 4096),
        ),
        "seed": st.integers(0, 2**64 - 1),
        "timer_ties": st.just("creation"),
        "livelock_limit": st.integers(1, 2**63 - 1),
    }
)


@given(jobs)
@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None, max_examples=cases(10, 40))
@example({"nodes": [NodeSpec(node="m:N", arguments={"a": {"\x85": "\u2028 \ufeff\n"}})]})
@example({"nodes": [NodeSpec(node="m:N", parameters={"a": "$(x) \\$(y) $($(", "b": ["$(z)"]})]})
def test_a_job_written_as_yaml_loads_as_itself(fields: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "bag").touch()
        job = Job(**fields, base_dir=folder)
        path = Path(folder, "job.yaml")
        path.write_text(job.to_yaml(), encoding="utf-8", newline="")
        loaded = load_job(path)
        assert loaded.resolved() == job.resolved()
        assert repr(loaded) == repr(job)  # also tells 1 from 1.0 and True
        assert loaded.to_yaml() == job.to_yaml()
        SCHEMA.validate(YAML(typ="safe", pure=True).load(job.to_yaml()))


def test_a_copy_with_changes_keeps_its_times() -> None:
    points = SeriesSpec(points=[["1s", "2ms"]])
    assert points.replace(steps=True).points == ((1_000_000_000, 2_000_000),)
    assert SamplesSpec(values=["1ms"]).replace(unit="ms").values_ns == (1_000_000,)
    assert ClockSpec(node="/a", offset="-1ms").replace(node="/b").offset_ns == -1_000_000
    assert ClockSpec(node="/a", offset_ns=-5).offset_ns == -5
    assert JumpSpec(at="1s", by="-2s").replace(at_ns=7) == JumpSpec(at_ns=7, by_ns=-2_000_000_000)


def test_the_yaml_of_a_job_is_short_and_readable() -> None:
    job = Job(
        nodes=[
            NodeSpec(
                node="m:N",
                parameters={"rate": 10.0, "nested": {"a": 1}},
                arguments={"a": None, "type": StopSpec},
            )
        ],
        start=1.5,
        stop=StopSpec(duration="2min", topic="/done"),
        record=RecordSpec(exclude=("/camera/*",)),
    )
    assert job.to_yaml() == (
        "nodes:\n"
        "  - node: m:N\n"
        "    parameters:\n"
        "      rate: 10.0\n"
        "      nested.a: 1\n"
        "    arguments:\n"
        "      a:\n"
        "      type: rsltrace.job.parts.stop:StopSpec\n"
        "start: 1.5s\n"
        "stop:\n"
        "  duration: 120s\n"
        "  topic:\n"
        "    name: /done\n"
        "record:\n"
        "  exclude:\n"
        "    - /camera/*\n"
    )


def test_the_resolved_job_is_complete_and_json_compatible() -> None:
    job = Job(nodes=[NodeSpec(node="m:N", parameters={"x": float("inf")})], start="1s")
    assert json.loads(json.dumps(job.resolved(), allow_nan=False)) == {
        "nodes": [
            {
                "node": "m:N",
                "name": None,
                "namespace": None,
                "parameters": {"x": ".inf"},
                "parameter_files": [],
                "remappings": {},
                "arguments": {},
                "on_exception": "stop",
                "guard": None,
            }
        ],
        "launch": [],
        "ros_arguments": [],
        "search_path": ["."],
        "start_ns": 1_000_000_000,
        "construct_time_ns": None,
        "stop": {
            "duration_ns": None,
            "time_ns": None,
            "timeout_ns": None,
            "events": None,
            "topic": None,
            "function": None,
            "quiescence_ns": None,
            "size": None,
        },
        "seed": 0,
        "timer_ties": "creation",
        "livelock_limit": 100_000,
        "bags": [],
        "record": {
            "payloads": True,
            "topics": ["*"],
            "exclude": [],
            "segment_events": 4096,
            "last": None,
        },
        "delay": None,
        "parallel": False,
        "policy": None,
        "threads": None,
        "min_time_step_ns": 0,
        "executors": None,
        "execution": None,
        "clocks": [],
        "checks": [],
        "faults": [],
        "metrics": {},
        "vary": None,
        "hooks": {"before": None, "after": None},
        "progress": None,
        "guard": {
            "enabled": True,
            "pin": True,
            "state": "false",
            **{
                name: {"mode": "virtual", "allow": []}
                for name in ("clock", "random", "directory", "order", "pid")
            },
            **{
                name: {"mode": "warn", "allow": []}
                for name in ("file", "environment", "thread", "process", "socket", "address")
            },
        },
    }


def test_the_resolved_job_does_not_depend_on_where_it_lies(tmp_path: Path) -> None:
    resolved = []
    for folder in (tmp_path / "here", tmp_path / "there" / "deeper"):
        (folder / "src").mkdir(parents=True)
        (folder / "bag.mcap").touch()
        (folder / "p.yaml").touch()
        (folder / "job.yaml").write_text(
            f"nodes: [{{node: m:N, parameter_files: [src/../p.yaml]}}]\n"
            f"search_path: [./src/, {folder}]\n"
            f"bags: [{folder}/bag.mcap, src/../bag.mcap]\n",
            encoding="utf-8",
        )
        resolved.append(load_job(folder / "job.yaml").resolved())
    assert resolved[0] == resolved[1]
    assert resolved[0]["search_path"] == ["src", "."]
    assert resolved[0]["nodes"][0]["parameter_files"] == ["p.yaml"]
    assert [bag["path"] for bag in resolved[0]["bags"]] == ["bag.mcap", "bag.mcap"]
