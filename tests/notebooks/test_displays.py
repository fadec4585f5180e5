"""What notebooks show of traces, diffs and jobs: every text a text, and none of it without end."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import rsltrace
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.html import HtmlSheet
from rsltrace.trace.reader import Trace
from rsltrace.trace.writer import TraceWriter

SAMPLES = Path(__file__).parents[2] / "sample_traces"
EVIL = "<img src=x onerror=alert(1)>&\"'\x1b]0;title\x07</pre><script>alert(2)</script>"


class Page(HTMLParser):
    """What a browser makes of it: tags, attributes and texts."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.attributes: set[str] = set()
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.open.append(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


HARMLESS = {*"div p strong span table thead tbody tr th td details summary pre".split()}


def shown(thing: object) -> Page:
    html = thing._repr_html_()  # type: ignore[attr-defined]
    page = Page(html)
    assert page.tags <= HARMLESS
    assert page.attributes <= {"class", "style"}
    return page


def test_a_trace_says_what_ran() -> None:
    with Trace.open(SAMPLES / "nondeterministic_callback" / "a.mcap") as trace:
        page = shown(trace)
        assert trace.digest in page.texts
    for text in ("trace a.mcap", "/obstacle_filter", "/scan", "sensor_msgs/msg/LaserScan", "126"):
        assert text in page.texts


def test_a_trace_that_was_closed_says_so() -> None:
    trace = Trace.open(SAMPLES / "nondeterministic_callback" / "a.mcap")
    trace.close()
    assert "closed file" in shown(trace).texts[-1]


def test_a_diff_says_where_and_why() -> None:
    folder = SAMPLES / "nondeterministic_callback"
    diff = rsltrace.diff(folder / "a.mcap", folder / "b.mcap")
    page = shown(diff)
    assert page.texts[0].startswith("/obstacle_filter: the callback for /scan at 2.1 s received")
    assert "-0.19956212899502732" in page.texts
    assert any(text.startswith("cause: ") and "hash_seed" in text for text in page.texts)
    assert diff.a.digest in page.texts
    same = rsltrace.diff(folder / "a.mcap", folder / "a.mcap")
    assert any("identical" in text for text in shown(same).texts)


def test_a_job_says_what_it_runs() -> None:
    job = rsltrace.load_job(SAMPLES / "nondeterministic_callback" / "job.yaml")
    page = shown(job)
    assert {spec.target for spec in job.nodes} <= set(page.texts)
    assert job.to_yaml().rstrip() in page.texts


def test_names_are_no_markup(tmp_path: Path) -> None:
    path = tmp_path / "evil.mcap"
    with TraceWriter(path, force=False) as writer:
        writer.add_entity(Entity(1, 1, EntityKind.NODE, EVIL, EVIL, 0, {}))
        writer.add_channel(EVIL, EVIL, "")
        writer.close(result={"stop_reason": EVIL, "exit_code": "0"})
    with Trace.open(path) as trace:
        page = shown(trace)
    assert sum("onerror" in text for text in page.texts) == 5
    assert not any("\x1b" in text for text in page.texts)
    job = rsltrace.Job(nodes=[rsltrace.NodeSpec(node="x:Y", parameters={"text": EVIL})])
    assert any("</script>" in text for text in shown(job).texts)


def test_much_is_cut() -> None:
    sheet = HtmlSheet("t" * 100_000)
    sheet.table(("n",), ((f"row {n} " + "x" * 1000,) for n in range(10_000)))
    sheet.text("\n".join("y" * 1000 for _ in range(10_000)), summary="all")
    html = sheet.html()
    assert len(html) < 20_000
    assert "… 9980 more" in html
    assert "… 9940 more lines" in html
