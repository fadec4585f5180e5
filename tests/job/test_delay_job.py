"""``delay:`` of a job: what it accepts, and what it says of mistakes; delay files, RSLCPP's too."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import pytest

from rsltrace.errors import JobError
from rsltrace.job import Job, load_job
from rsltrace.run.plans.network import network_plan
from rsltrace.simulation.chance.channel import BurstLoss, LinkModel, LinkOutage
from rsltrace.simulation.chance.distribution import (
    Constant,
    Empirical,
    Gamma,
    Lognormal,
    MeasuredSamples,
    Normal,
    TimeSeries,
    Uniform,
)

MS = 1_000_000
S = 1_000_000_000


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def load(delay: str) -> Job:
    text = "nodes: [{node: 'a:B'}]\ndelay:\n" + dedent(delay).replace("\n", "\n  ").rstrip(" ")
    text = text.replace("delay:\n", "delay:\n  ", 1)
    Path("job.yaml").write_text(text, encoding="utf-8")
    return load_job("job.yaml")


def mistake(delay: str) -> str:
    """Return the message, without the lines that show the place."""
    with pytest.raises(JobError) as caught:
        network_plan(load(delay), 0)
    return str(caught.value).splitlines()[0]


def model(spec: str) -> LinkModel:
    plan = network_plan(load(f"default: {spec}\n"), 0)
    assert plan is not None
    assert plan.default is not None
    return plan.default


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("5ms", Constant(5 * MS)),
        ("0.005", Constant(5 * MS)),
        ("{constant: 5ms}", Constant(5 * MS)),
        ("{uniform: {min: 1ms, max: 3ms}}", Uniform(MS, 3 * MS)),
        ("{normal: {mean: 5ms, sd: 1ms}}", Normal(5 * MS, MS)),
        ("{lognormal: {median: 5ms, sigma: 0.5}}", Lognormal(5 * MS, 0.5)),
        ("{lognormal: {mean: 5ms, sd: 2ms}}", Lognormal.of_moments(5 * MS, 2 * MS)),
        ("{gamma: {shape: 2, scale: 1ms}}", Gamma(2.0, MS)),
        ("{gamma: {mean: 5ms, sd: 2ms}}", Gamma.of_moments(5 * MS, 2 * MS)),
        ("{samples: {values: [1ms, 2ms]}}", MeasuredSamples((MS, 2 * MS))),
        ("{empirical: {values: [1ms, 1ms, 4ms]}}", Empirical((0, 50, 100), (MS, MS, 4 * MS))),
        (
            "{empirical: {values: [0s, 1ms, 4ms], percent: [0, 99.5, 100]}}",
            Empirical((0, 99.5, 100), (0, MS, 4 * MS)),
        ),
        ("{series: {points: [[0s, 1ms], [1s, 2ms]]}}", TimeSeries(((0, MS), (S, 2 * MS)))),
        ("{series: {points: [[0, 1ms]], steps: true}}", TimeSeries(((0, MS),), True)),
        ("{drop: 0.1}", None),
    ],
)
def test_every_distribution(spec: str, expected: object) -> None:
    assert model(spec).delay == expected


def test_everything_else_of_a_model() -> None:
    assert model(
        "{drop: 0.1, duplicate: 0.2, keep_order: false, retransmit: 3ms, "
        "burst: {good_to_bad: 0.1, bad_to_good: 0.5, loss_bad: 0.9, loss_good: 0.01}}"
    ) == LinkModel(None, 0.1, BurstLoss(0.1, 0.5, 0.9, 0.01), 0.2, False, 3 * MS)


def test_rules_and_outages_of_a_plan() -> None:
    job = load(
        """\
        topics: {/a: 1ms, /b*: {drop: 0.5}}
        links:
          - {topic: /a, from: /x, to: /y, constant: 2ms}
        services: {/s: 3ms}
        outages:
          - {topic: /a, from: 1s, to: 2s}
          - {node: /x, from: 0, to: 500ms}
        """
    )
    plan = network_plan(job, 100 * S)
    assert plan is not None
    assert [(rule.name, rule.model) for rule in plan.topics] == [
        ("/a", LinkModel(Constant(MS))),
        ("/b*", LinkModel(drop=0.5)),
    ]
    (link,) = plan.links
    assert (link.topic, link.sender, link.receiver) == ("/a", "/x", "/y")
    assert plan.outages[0].outage == LinkOutage(101 * S, 102 * S)
    assert (plan.outages[1].kind, plan.outages[1].outage) == (
        "node",
        LinkOutage(100 * S, 100 * S + 500 * MS),
    )
    again = job.to_yaml()
    Path("again.yaml").write_text(again)
    assert network_plan(load_job("again.yaml"), 100 * S) == plan


@pytest.mark.parametrize(
    ("delay", "message"),
    [
        (
            "topics: {/a: {constnt: 5ms}}",
            "job.yaml:3:17: unknown key 'constnt' in delay.topics./a; did you mean 'constant'?",
        ),
        (
            "topics: {a: 5ms}",
            "job.yaml:3:12: delay.topics: topic names start with '/': write '/a' (or '*a')",
        ),
        (
            "default: {constant: 5ms, uniform: {min: 0, max: 1ms}}",
            "job.yaml:3:28: delay.default: give one of constant and uniform, not both",
        ),
        ("default: 5", None),
        (
            "default: 5 parsecs",
            "job.yaml:3:12: delay.default.constant: unknown unit 'parsecs' in '5 parsecs'; "
            "units are ns, us, ms, s, min, h",
        ),
        (
            "default: {uniform: {min: 5ms, max: 1ms}}",
            "job.yaml:3:38: delay.default.uniform.max: max is less than min",
        ),
        (
            "default: {uniform: {min: 5ms}}",
            "job.yaml:3:22: delay.default.uniform: the key 'max' is missing",
        ),
        (
            "default: {lognormal: {mean: 5ms, sigma: 1}}",
            "job.yaml:3:24: delay.default.lognormal: give either mean and sd, or median and sigma",
        ),
        (
            "default: {drop: 1.5}",
            "job.yaml:3:19: delay.default.drop: must be at least 0 and at most 1, got 1.5",
        ),
        (
            "default: {drop: 5ms}",
            "job.yaml:3:19: delay.default.drop: expected a number, got text '5ms'",
        ),
        (
            "default: {keep_order: 1}",
            "job.yaml:3:25: delay.default.keep_order: expected true or false, got the number 1",
        ),
        (
            "services: {/a: {constant: 1ms, duplicate: 0.1}}",
            "job.yaml:3:45: delay.services./a.duplicate: requests and responses of services never "
            "arrive twice",
        ),
        (
            "outages: [{from: 1s, to: 2s}]",
            "job.yaml:3:13: delay.outages[0]: give one of topic, service or node",
        ),
        (
            "outages: [{node: /a, from: 2s, to: 1s}]",
            "job.yaml:3:38: delay.outages[0].to: the outage ends before it begins",
        ),
        (
            "default: {samples: {values: []}}",
            "job.yaml:3:31: delay.default.samples.values: an empty list has nothing to draw from",
        ),
        (
            "default: {empirical: {values: [1ms]}}",
            "job.yaml:3:24: delay.default.empirical: a table needs two values at least, the least "
            "and the greatest",
        ),
        (
            "default: {empirical: {values: [2ms, 1ms]}}",
            "job.yaml:3:39: delay.default.empirical.values[1]: it is less than the one before",
        ),
        (
            "default: {empirical: {values: [1ms, 2ms], percent: [0, 50, 100]}}",
            "job.yaml:3:54: delay.default.empirical.percent: 2 values need as many, got 3",
        ),
        (
            "default: {empirical: {values: [1ms, 2ms], percent: [5, 100]}}",
            "job.yaml:3:55: delay.default.empirical.percent[0]: expected 0, of the least value",
        ),
        (
            "default: {empirical: {values: [1ms, 2ms, 3ms], percent: [0, 0, 100]}}",
            "job.yaml:3:63: delay.default.empirical.percent[1]: it is not more than the one before",
        ),
        (
            "default: {series: {points: [[1s, 1ms], [1s, 2ms]]}}",
            "job.yaml:3:42: delay.default.series.points[1]: its time is not after that of the "
            "point before",
        ),
        (
            "default: {samples: {file: gone.txt}}",
            "job.yaml:3:29: delay.default.samples.file: 'gone.txt': there is no such file",
        ),
    ],
)
def test_mistakes_are_shown_where_they_are(delay: str, message: str | None) -> None:
    if message is None:
        load(delay + "\n")
    else:
        assert mistake(delay + "\n") == message


def test_samples_and_series_from_files(folder: Path) -> None:
    (folder / "s.txt").write_text("# measured\n4.5\n5ms\n\n0.1  # odd\n")
    assert model("{samples: {file: s.txt, unit: ms}}").delay == MeasuredSamples(
        (4_500_000, 5 * MS, 100_000)
    )
    (folder / "s.csv").write_text("time,delay\n0,0.001\n10,20ms\n")
    assert model("{series: {file: s.csv}}").delay == TimeSeries(((0, MS), (10 * S, 20 * MS)))
    (folder / "bad.txt").write_text("1\nnan\n")
    assert mistake("default: {samples: {file: bad.txt, unit: ms}}\n").startswith("bad.txt:2:1: ")
    (folder / "bad.csv").write_text("0,1\n0,2\n")
    assert mistake("default: {series: {file: bad.csv}}\n").startswith("bad.csv:2:1: its time")
    (folder / "empty.txt").write_text("\n")
    assert mistake("default: {samples: {file: empty.txt}}\n").startswith("empty.txt: it has no")


def test_measured_values_are_rounded_to_nanoseconds(folder: Path) -> None:
    # As numpy.savetxt writes them, and a difference of two time.perf_counter().
    (folder / "s.txt").write_text("4.812345678912345678e-03\n0.0000000005\n1e-40\n")
    assert model("{samples: {file: s.txt}}").delay == MeasuredSamples((4_812_346, 0, 0))
    (folder / "s.csv").write_text("t0,v1\n0.1234567891,0.00123456789\n")
    assert model("{series: {file: s.csv}}").delay == TimeSeries(((123_456_789, 1_234_568),))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1\n 1;2\n", "sub/s.txt:2:2: expected one value per line, got '1;2'"),
        ("1,2\n", "sub/s.txt:1:1: expected one value per line, got '1,2'"),
        ("# ms\ndelay\n", "sub/s.txt:2:1: expected a time, got 'delay': a header is left out"),
        ("-1\n", "sub/s.txt:1:1: a time must not be negative, got -1"),
        ("1e400\n", "sub/s.txt:1:1: 1e400 is too large"),
        ("20000h\n", "sub/s.txt:1:1: 20000h is too long: at most 10007h"),
    ],
)
def test_a_mistake_in_a_file_is_shown_with_its_line(folder: Path, text: str, message: str) -> None:
    (folder / "sub").mkdir()
    (folder / "sub" / "s.txt").write_text(text)
    with pytest.raises(JobError) as caught:
        network_plan(load("default: {samples: {file: sub/s.txt}}\n"), 0)
    told = str(caught.value)
    assert told.startswith(message)
    number = int(message.split(":")[1])
    assert told.splitlines()[1] == f"{number:>5} | {text.splitlines()[number - 1]}"


def test_files_in_other_encodings_are_told_what_they_are(folder: Path) -> None:
    (folder / "s.txt").write_bytes("1\n2\n".encode("utf-16"))
    assert "s.txt: this is UTF-16" in mistake("default: {samples: {file: s.txt}}\n")
    (folder / "s.txt").write_bytes(b"1\n# \xe4\n")
    assert "s.txt:2: not UTF-8: byte 0xe4" in mistake("default: {samples: {file: s.txt}}\n")


# RSLCPP's own example, as far as it can be reproduced.
RSLCPP = """\
Topic Name               , Delay Type (FIXED/MEASURED), Fixed Delay_ms, Measured Delay Skew
/fixed_delay_1           , FIXED                      ,             10,
/fixed_delay_2           , FIXED                      ,            300,
/fine                    , FIXED                      ,            0.25,
"""


def test_rslcpps_table_of_fixed_delays(folder: Path) -> None:
    (folder / "d.csv").write_text(RSLCPP)
    plan = network_plan(
        load("file: d.csv\ntopics: {/fixed_delay_2: 1ms, '/*_1': 2ms}\ndefault: 3ms\n"), 0
    )
    assert plan is not None

    def delay_of(topic: str) -> int:
        link = plan.topic_channel(topic, ("/a", 0), ("/b", 0), reliable=True)
        assert link is not None
        return link.transmit(0)

    assert [delay_of(t) for t in ("/fixed_delay_1", "/fixed_delay_2", "/fine", "/x")] == [
        2 * MS,  # the job's own word comes first, in a glob, too
        MS,
        250_000,
        3 * MS,
    ]


def test_a_table_without_rows_and_samples_with_a_header_are_refused(folder: Path) -> None:
    (folder / "d.csv").write_text("Topic,Type,Delay,Skew\n\n")
    assert mistake("file: d.csv\n").startswith("d.csv: it has no delays: below its header, ")
    (folder / "s.txt").write_text("delay_ms\n1\n")
    text = mistake("default: {samples: {file: s.txt, unit: ms}}\n")
    assert text.startswith("s.txt:1:1: expected a time, got 'delay_ms': a header is left out")


def test_a_table_without_header_does_not_lose_its_first_line(folder: Path) -> None:
    (folder / "d.csv").write_text("/a,FIXED,5,\n/b,FIXED,5,\n")
    assert mistake("file: d.csv\n").startswith("d.csv:1:1: the first line is a header")
    (folder / "d.csv").write_text("\n/b,FIXED,5,\n")  # the first line is empty
    plan = network_plan(load("file: d.csv\n"), 0)
    assert plan is not None
    assert [(rule.name, rule.where) for rule in plan.table] == [("/b", "d.csv:2")]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("/m , MEASURED , , 1.0", "MEASURED takes the delay from how long the callback ran"),
        ("/m , FIXD , 1,", "expected FIXED or MEASURED, got 'FIXD'"),
        ("/m , FIXED , ,", "the delay of /m in milliseconds is missing"),
        ("/m , FIXED , ten,", "expected a delay in milliseconds, got 'ten'"),
        ("/m , FIXED , -1,", "a delay in milliseconds cannot be -1"),
        ("m , FIXED , 1,", "a topic is named in full"),
        ("/m FIXED 1", "expected four columns"),
    ],
)
def test_mistakes_in_rslcpps_table(folder: Path, line: str, message: str) -> None:
    (folder / "d.csv").write_text(RSLCPP + line + "\n")
    assert mistake("file: d.csv\n").startswith(f"d.csv:5:1: {message}")
