"""Jobs with one mistake each: every message must be enough to correct it without the docs.

The messages are in ``golden/broken.txt``, to be read by a person when they change:
``pytest --update-golden tests/job/test_broken_jobs.py`` writes them anew.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML, YAMLError

from rsltrace.errors import JobError
from rsltrace.job import load_job
from rsltrace.job.documents.schema import job_schema
from tests.golden_files import check_golden

GOLDEN = Path(__file__).parent / "golden"
GOOD = (GOLDEN / "good.yaml").read_text("utf-8")

# What is written, and what is written instead: one mistake, in the line of the difference.
MISTAKES = [
    # keys
    ("nodes:", "node:"),
    ("    name: ekf", "    nmae: ekf"),
    ("    parameters:", "    parametrs:"),
    ("    parameter_files:", "    params_file:"),
    ("    remappings: {odom", "    remap: {odom"),
    ("    on_exception: log", "    onexception: log"),
    ("search_path:", "searchpath:"),
    ("construct_time:", "construction_time:"),
    ("    start_offset:", "    offset:"),
    ("  duration: 60s", "  durations: 60s"),
    ("  quiescence: 2s", "  quiet: 2s"),
    ("exit_code: data", "exitcode: data"),
    ("timer_ties: creation", "timer-ties: creation"),
    ("delay:", "delays:"),
    ("{min: 1ms", "{minimum: 1ms"),
    ("{clock: virtual", "{clocks: virtual"),
    ("seed: 7", "frobnicate: 7"),
    ("seed: 7", "Seed: 7"),
    # types
    ("seed: 7", "seed: seven"),
    ("seed: 7", "seed: 7.5"),
    ("seed: 7", 'seed: "7"'),
    ("seed: 7", "seed:"),
    ("seed: 7", "seed: [7]"),
    ("search_path: [., src]", "search_path: src"),
    ("    topics: [/imu/*, /fix]", "    topics: /imu/*"),
    ("    remappings: {odom: /husky/odom}", "    remappings: [odom, /husky/odom]"),
    ("    parameters: {frequency: 50.0, gains: [1.0, 2.0], frame: odom}", "    parameters: 50.0"),
    ("gains: [1.0, 2.0]", "gains: [1.0, x]"),
    ("gains: [1.0, 2.0]", "gains: [1.0, 2]"),
    ("frame: odom", "frame: null"),
    ("    arguments: {size: 3}", "    arguments: 3"),
    ("  payloads: true", "  payloads: 1"),
    ("  payloads: true", '  payloads: "yes"'),
    ("    rate: 2.0", "    rate: fast"),
    ("    loop: 3", "    loop: often"),
    ("  - node: my_robot.planner:Planner", "  - node: [my_robot.planner, Planner]"),
    ("stop:\n  duration: 60s", "stop: 60s\n\nx_:\n  duration: 60s"),
    # values
    ("my_robot.ekf:EkfNode", "my_robot.ekf.EkfNode"),
    ("my_robot.ekf:EkfNode", "my_robot/ekf.py"),
    ("    name: ekf", "    name: 2nd-ekf"),
    ("    namespace: /robot1", "    namespace: robot1"),
    ("    namespace: /robot1", "    namespace: /robot 1"),
    ("{odom: /husky/odom}", '{"*": /husky/odom}'),
    ("{odom: /husky/odom}", "{__node: ekf2}"),
    ("    on_exception: log", "    on_exception: logg"),
    ("thread: warn", "thread: virtual"),
    ("start: 10s", "start: 10 seconds"),
    ("start: 10s", "start: 10sec"),
    ("start: 10s", "start: 0:10"),
    ("start: 10s", "start: -10s"),
    ("  duration: 60s", '  duration: "60"'),
    ("  duration: 60s", "  duration: 1.0000000001"),
    ("  duration: 60s", "  duration: .inf"),
    ("construct_time: 0s", "construct_time: 11s"),
    ("  time: 80s", "  time: 8s"),
    ("  events: 100000", "  events: 0"),
    ("  events: 100000", "  events: 1e5"),
    ("{name: /done", "{name: done"),
    ("exit_code: data", "exit_code: data[0]"),
    ("  quiescence: 2s", "  quiescence: 0s"),
    ("seed: 7", "seed: -1"),
    ("seed: 7", "seed: 18446744073709551616"),
    ("timer_ties: creation", "timer_ties: heaps"),
    ("livelock_limit: 100000", "livelock_limit: 100_000.0"),
    ("[/camera/*]", "[camera/*]"),
    ("    rate: 2.0", "    rate: 0"),
    ("    loop: 3", "    loop: 0"),
    ("by: header_stamp", "by: header_time"),
    ("{/fix: /gps/fix}", "{fix: /gps/fix}"),
    ("durability: transient_local", "durability: transient-local"),
    ("depth: 1", "depth: 0"),
    ("max: 5ms", "max: 0.5ms"),
    ("  - path: bag", "  - path: bags"),
    ("[ekf.yaml]", "[efk.yaml]"),
    ("[., src]", "[., source]"),
    ("$(var robot)", "$(var robt)"),
    ("$(var robot)", "$(env NO_SUCH_ROBOT)"),
    ("$(var robot)_planner", "$(var robot"),
    ("{robot: husky}", "{robot: [husky]}"),
    # how other programs, or other parts of a job, would have it
    ("  payloads: true", "  payloads: on"),
    ("{uniform: {min: 1ms, max: 5ms}}", "{uniform: [1ms, 5ms]}"),
    ("{uniform: {min: 1ms, max: 5ms}}", "{samples: [1ms, 5ms]}"),
    ("{uniform: {min: 1ms, max: 5ms}}", "{normal: {mu: 1ms, sd: 2ms}}"),
    ("{uniform: {min: 1ms, max: 5ms}}", "{uniform: {min: 1ms, max: 5ms}, constant: 1ms}"),
    ("{/scan: {uniform", "{scan: {uniform"),
    ("  default: 1ms", "  constant: 1ms"),
    ("  default: 1ms", "  default: {drop: 5%}"),
    ("  default: 1ms", "  default: {drop: 5}"),
    ("  default: 1ms", "  default: {uniform:}"),
    ("  default: 1ms", "  default: 20000h"),
    ("seed: 7", "execution:"),
    ("seed: 7", "policy: priority"),
    ("seed: 7", "executors: multi_threaded"),
    ("seed: 7", "clocks: [{node: lidar, offset: 1s}]"),
    ("seed: 7", "clocks: [{node: /lidar, random_jumps: {every: 1us, most: 1s}}]"),
    ("seed: 7", "seed: ${SEED}"),
    ("seed: 7", "policy: permute"),
    ("seed: 7", "policy: FIFO"),
    ("seed: 7", "policy: random"),
    ("seed: 7", "clocks: [{node: /ekf, jumps: [[5s, 100ms]]}]"),
    ("  default: 1ms", "  links: [{topic: /scan, receiver: /ekf, constant: 1ms}]"),
    ("seed: 7", "policy: {priority: {/planner: 10}}"),
    ("seed: 7", "duration: 60s"),
    ("  default: 1ms", "  /scan: 1ms"),
    ("  default: 1ms", "  default: 0,5 ms"),
    ("  default: 1ms", "  outages: [{node: /ekf, from: 1s, to: 1s}]"),
    ("[., src]", "[., ~/src]"),
    ("[., src]", "[., $WORKSPACE/src]"),
    # YAML
    ("seed: 7", "seed: @7"),
    ("{min: 1ms", "{min:1ms"),
    ("  - node: my_robot.planner:Planner", "  -node: my_robot.planner:Planner"),
    ("seed: 7", f"seed: {'9' * 101}"),
    ("seed: 7", "seed: \x1b[31m7"),
    ("    name: ekf", "   name: ekf"),
    ("    name: ekf", "\tname: ekf"),
    ("    name: ekf", "    name ekf"),
    ("    name: ekf", "    name: ekf: one"),
    ("    name: ekf", '    name: "ekf'),
    ("    name: ekf", "    name: ekf\n    name: ekf2"),
    ("[., src]", "[., src"),
    ("    name: ekf", "    name: *ekf"),
    ("    name: ekf", "    name: !robot ekf"),
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run in a folder with all that the good job names."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NO_SUCH_ROBOT", raising=False)
    for name in ("src", "bag"):
        (tmp_path / name).mkdir()
    (tmp_path / "ekf.yaml").touch()
    return tmp_path


def broken() -> Iterator[tuple[str, str, int]]:
    """Yield (what was done, the job, the number of the changed line)."""
    for old, new in MISTAKES:
        assert GOOD.count(old) >= 1, old
        at = GOOD.index(old)
        before = GOOD[:at]
        line = before.count("\n") + 1
        yield f"{old.strip()}  ->  {new.strip()}", before + new + GOOD[at + len(old) :], line


def message(text: str) -> str:
    Path("job.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(JobError) as caught:
        load_job("job.yaml")
    return str(caught.value)


def test_the_good_job_is_good() -> None:
    Path("job.yaml").write_text(GOOD, encoding="utf-8")
    assert load_job("job.yaml").nodes


def test_every_mistake_is_told_as_written_down() -> None:
    told = ""
    for number, (what, text, _) in enumerate(broken(), 1):
        shown = what.replace("\n", "\\n").replace("\t", "\\t")
        told += f"--- {number}. {shown}\n{message(text)}\n\n"
    check_golden(GOLDEN / "broken.txt", told)


@pytest.mark.parametrize(("what", "text", "line"), list(broken()), ids=[w for w, _, _ in broken()])
def test_the_first_place_told_is_that_of_the_mistake(what: str, text: str, line: int) -> None:
    told = message(text)
    place = re.match(r"job\.yaml:(\d+):(\d+): ", told)
    assert place is not None, told
    # What is left open by a missing bracket or quote may only be missed in the next line.
    assert line <= int(place[1]) <= line + 1, told
    shown = told.splitlines()[1]
    assert shown.startswith(f"{place[1]:>5} | ")
    assert told.splitlines()[2].rstrip().endswith("^")


def test_most_mistakes_are_seen_by_the_schema_too() -> None:
    validator = jsonschema.Draft202012Validator(job_schema())
    assert not list(validator.iter_errors(YAML(typ="safe", pure=True).load(GOOD)))
    seen = total = 0
    for _, text, _ in broken():
        try:
            value = YAML(typ="safe", pure=True).load(text)
        except YAMLError:
            continue  # no editor needs a schema for that
        total += 1
        seen += not validator.is_valid(value)
    assert total > 60
    assert seen / total > 0.75, f"{seen} of {total}"


def keys_of_good() -> list[tuple[int, str]]:
    """Return (line, key) of every key of the good job that the models know."""
    free = ("gains", "frame", "frequency", "odom", "size", "robot", "scan", "vars")
    found = []
    for number, line in enumerate(GOOD.splitlines(), 1):
        for key in re.findall(r"([a-z_]{4,}):(?= |$)", line):
            if key not in free:
                found.append((number, key))
    return found


@pytest.mark.few(30)
@pytest.mark.parametrize(("line", "key"), keys_of_good())
def test_a_typing_error_in_any_key_is_told_with_the_key_that_was_meant(line: int, key: str) -> None:
    for wrong in (key[:-1], key[0] + key, key[:1] + key[2] + key[1] + key[3:]):
        if wrong == key:
            continue
        lines = GOOD.splitlines()
        lines[line - 1] = lines[line - 1].replace(f"{key}:", f"{wrong}:", 1)
        told = message("\n".join(lines) + "\n")
        first = f"unknown key '{wrong}'"
        assert any(
            part.startswith(f"job.yaml:{line}:") and first in part and f"'{key}'" in part
            for part in told.splitlines()
        ), told
