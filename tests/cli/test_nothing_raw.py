"""Whatever is in a trace, a bag or a job: no command sends a terminal what could steer it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from mcap import records
from mcap.opcode import Opcode

from campaigns.attack import mcap_parts
from campaigns.attack.families.texts import with_strings
from rsltrace.cli.main import cli
from rsltrace.trace.model.texts import printable_lines
from rsltrace.trace.reader import Trace

SAMPLES = Path(__file__).parents[2] / "sample_traces"
ESCAPES = "\x1b]0;owned\x07\x1b[2J\r\x08\x9b31m\u202eevil\u2066"
_RAW = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_TOPICS = (
    "/rsltrace/entities",
    "/rsltrace/details",
    "/rsltrace/findings",
    "/rsltrace/states",
    "/rsltrace/code_lines",
)

Run = Callable[..., str]


def _hostile(source: Path, target: Path, *, schemas: bool) -> None:
    """Write a trace with escapes in every text; ``schemas``: also where decoding needs them."""
    parts = mcap_parts.take_apart(source.read_bytes())
    for part in parts:
        record = part.record if part.opcode in (Opcode.METADATA, Opcode.ATTACHMENT) else None
        if isinstance(record, records.Metadata) and not record.name.startswith("rosbag2"):
            kept = ("digest", "version", "resolved", "checksum")
            record.metadata = {
                key: text if key in kept else text + ESCAPES
                for key, text in record.metadata.items()
            }
            part.record = record
        elif isinstance(record, records.Attachment) and record.name == "job.yaml":
            text = f"# The effective job of x{ESCAPES}\n#   with --set x={ESCAPES}\nx: {ESCAPES}\n"
            record.data = text.encode()
            part.record = record
        elif schemas and part.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            other = part.record
            if isinstance(other, records.Schema) and "rsltrace" not in other.name:
                other.name += ESCAPES
            elif isinstance(other, records.Channel) and not other.topic.startswith("/rsltrace"):
                other.topic += ESCAPES
            part.record = other
    for topic in _TOPICS:
        mcap_parts.change_messages(
            parts,
            topic,
            lambda data, nth, topic=topic: with_strings(
                data, topic, lambda n, text: text and text + ESCAPES.encode() if n == 0 else text
            ),
        )
    target.write_bytes(mcap_parts.put_together(parts))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    for side in "ab":
        sample = SAMPLES / "nondeterministic_callback" / f"{side}.mcap"
        _hostile(sample, folder / f"{side}.mcap", schemas=False)
        _hostile(sample, folder / f"{side}2.mcap", schemas=True)
    with Trace.open(folder / "a2.mcap") as trace:
        assert any(ESCAPES in entity.name for entity in trace.entities.values())
    bag = folder / f"bag{ESCAPES.replace('/', '')}"
    bag.mkdir()
    (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {ESCAPES}\n")
    (folder / "bad.yaml").write_text(f'"k{ESCAPES}": "v{ESCAPES}"\n', encoding="utf-8")
    (folder / "escaped.yaml").write_text(
        'nodes: [{node: "m\\e]0;x\\a:N"}]\nstop: {duration: "\\x9b1"}\n"k\\r\\b": 1\n'
    )
    line = {"time": "2026-11-01T10:00:00.000Z", "by": ESCAPES, "verdict": "failed"}
    line |= dict.fromkeys(("job", "commit", "branch", "reason"), ESCAPES)
    lines = [json.dumps({**line, "digest": digit * 16}) for digit in "ab"]
    (folder / f"runs{ESCAPES}.jsonl").write_text("\n".join([*lines, ESCAPES]), encoding="utf-8")
    (folder / f"x{ESCAPES}.mcap").write_bytes((folder / "a.mcap").read_bytes())
    return folder


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(folder)

    def run(*words: str) -> str:
        result = CliRunner().invoke(cli, words)
        return result.output

    return run


_TRACES = ("a.mcap", "a2.mcap", f"x{ESCAPES}.mcap")


@pytest.mark.parametrize(
    "words",
    [
        *(("info", trace, *more) for trace in _TRACES for more in ((), ("--all",), ("--json",))),
        *(("cat", trace) for trace in _TRACES),
        *(("cat", trace, "--json", "--payloads") for trace in _TRACES),
        ("cat", "a.mcap", "--node", ESCAPES),
        ("info", "a.mcap", "--check"),
        *(("latency", "a.mcap", *more) for more in ((), ("--format", "csv"), ("b.mcap",))),
        ("latency", "a.mcap", "--from", f"/scan{ESCAPES}"),
        *(("why", trace, f"/driver{ESCAPES}", f"/push{ESCAPES}") for trace in _TRACES),
        ("why", "a.mcap", ESCAPES, "push"),
        ("why", "a.mcap", f"/driver{ESCAPES}", ESCAPES),
        ("why", "a.mcap", f"/driver{ESCAPES}", f"/scan{ESCAPES}"),
        ("export", "a2.mcap", "-o", f"out{ESCAPES}"),
        ("export", "a2.mcap", "--layout", f"layout{ESCAPES}"),
        *(
            ("diff", "a.mcap", "b.mcap", "--format", form)
            for form in ("text", "markdown", "github", "html")
        ),
        ("info", "a2.mcap", "--format", "html"),
        *(("history", f"runs{ESCAPES}.jsonl", *more) for more in ((), ("--json",))),
        ("history", f"runs{ESCAPES}.jsonl", "--format", "html"),
        ("diff", "a2.mcap", "b2.mcap", "--all"),
        ("diff", "a2.mcap", "b2.mcap", "--abs", "*=1"),
        ("diff", "a.mcap", "b.mcap", "--check"),
        ("diff", "a.mcap", f"bag{ESCAPES.replace('/', '')}"),
        ("diff", "a.mcap", f"gone{ESCAPES}"),
        ("view", f"gone{ESCAPES}"),
        ("check", "bad.yaml"),
        ("check", "escaped.yaml"),
        ("record", "bad.yaml"),
        ("record", "escaped.yaml", "--print-job"),
        ("record", "a.mcap"),
        ("audit", "bad.yaml"),
        ("audit", f"gone{ESCAPES}.py"),
        ("init", "new.yaml", "--from", f"bag{ESCAPES.replace('/', '')}"),
        ("verify", "escaped.yaml"),
        ("rerun", f"gone{ESCAPES}"),
        (f"no{ESCAPES}",),
        ("info", f"--{ESCAPES}"),
        ("schema",),
    ],
    ids=lambda words: " ".join(words).encode("unicode_escape").decode()[:60],
)
def test_no_command_shows_it_raw(run: Run, words: tuple[str, ...]) -> None:
    said = run(*words)
    assert said
    raw = _RAW.search(said)
    assert raw is None, repr(said[max(raw.start() - 80, 0) : raw.end() + 20])


def test_lines_and_tabs_stay() -> None:
    text = "Traceback:\n\tFile é ✓\n"
    assert printable_lines(text) == text
    assert printable_lines("a\x1b[1m\r\nb") == "a\\x1b[1m\\r\nb"
    assert not _RAW.search(printable_lines(ESCAPES))
