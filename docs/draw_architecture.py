"""``docs/pictures/architecture.svg``, drawn from the text below (``make docs``).

``architecture`` returns the picture; a test fails when the file is stale or a package has no box.
"""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import NamedTuple

PICTURE = Path(__file__).parent / "pictures" / "architecture.svg"
WIDTH, HEIGHT = 1240, 812
INK, FAINT, PAPER = "#1f2933", "#52606d", "#ffffff"
MESSAGE, TRACE = "#c2410c", "#1d4ed8"


class Box(NamedTuple):
    """A package: where it is drawn, its name, what it is for; a way may pass left of the text."""

    x: int
    y: int
    width: int
    height: int
    name: str
    purpose: str = ""
    fill: str = "#ffffff"
    indent: int = 12


RUNNING, READING, SHARED, ROOM = "#fdf1e7", "#e8effb", "#eef0f2", "#ffffff"

BOXES = (
    Box(180, 44, 223, 54, "testing · mcp_server", "a pytest plugin; tools of agents", SHARED),
    Box(413, 44, 223, 54, "viewer", "terminal screens, Rerun", SHARED),
    Box(646, 44, 444, 54, "cli", "the commands", SHARED),
    Box(180, 108, 145, 54, "search", "many runs", RUNNING),
    Box(335, 108, 146, 54, "replay · debug · native", "checked again; observed", RUNNING),
    Box(491, 108, 145, 54, "checks · conditions", "what must hold", RUNNING),
    Box(180, 172, 456, 54, "run", "puts what is below together for one job", RUNNING),
    Box(180, 236, 456, 212, "adapters", "speak for nodes, bags and test drivers", RUNNING),
    Box(192, 284, 432, 128, "rclpy", "", ROOM),
    Box(192, 416, 211, 28, "player", "", ROOM, 48),
    Box(413, 416, 211, 28, "driver", "", ROOM, 54),
    Box(180, 458, 278, 54, "job", "what a run is to do, with what", RUNNING),
    Box(468, 458, 168, 54, "guard", "clocks, chance, files", RUNNING),
    Box(180, 522, 456, 66, "simulation/middleware", "graph, QoS, links", RUNNING, 56),
    Box(180, 598, 456, 66, "simulation/loop", "simulated time", RUNNING, 56),
    Box(
        180, 674, 456, 56, "simulation/chance", "delays and losses from named streams", RUNNING, 56
    ),
    Box(646, 108, 444, 270, "diff", "where two runs diverge, and why", READING),
    Box(658, 160, 268, 64, "report", "text, JSON, Markdown, one line", ROOM),
    Box(658, 232, 268, 64, "causes · traces · bags", "roots, consequences, evidence", ROOM),
    Box(658, 304, 268, 64, "alignment · values · result", "which event is which", ROOM),
    Box(
        646,
        388,
        280,
        54,
        "words · checks/latency · diff/why",
        "said; measured; explained",
        READING,
    ),
    Box(646, 452, 354, 136, "trace", "events, outputs, payloads, hashes", READING),
    Box(1010, 452, 80, 136, "recordings", "rosbag2", READING),
    Box(646, 598, 444, 132, "trace/mcap", "records, chunks, indexes; cut-off, remote", READING, 49),
    Box(
        180,
        740,
        910,
        54,
        "trace/model · errors",
        "frozen values that all share; every error",
        SHARED,
    ),
)

OUTSIDE = (
    Box(16, 284, 140, 128, "your nodes", "unmodified rclpy"),
    Box(1112, 44, 112, 54, "you", "screen, CI"),
)


class Step(NamedTuple):
    """A stop on a way: its badge, and what happens there (lines of text to the right of it)."""

    x: int
    y: int
    mark: str
    text: tuple[str, ...]
    color: str


STEPS = (
    Step(212, 322, "1", ("publish() (handles)",), MESSAGE),
    Step(450, 322, "2", ("to CDR bytes (wire)",), MESSAGE),
    Step(450, 555, "3", ("matched, delayed,", "queued, or lost"), MESSAGE),
    Step(450, 646, "4", ("its time has come,", "and it is next"), MESSAGE),
    Step(212, 374, "5", ("taken, decoded: your", "callback runs (stacks)"), MESSAGE),
    Step(678, 540, "6", ("the event has ended: a row", "and its chain hash"), MESSAGE),
    Step(678, 684, "7", ("rows in a chunk,", "compressed"), MESSAGE),
    Step(962, 684, "A", ("checked, read", "in place"), TRACE),
    Step(962, 540, "B", (), TRACE),
    Step(962, 336, "C", ("the first event", "that differs"), TRACE),
    Step(962, 264, "D", ("what caused it,", "what follows"), TRACE),
    Step(962, 192, "E", ("said in words",), TRACE),
    Step(962, 71, "F", (), TRACE),
)

WAYS = (
    (MESSAGE, "M156 322 H450 V646 H212 V374 H156"),
    (MESSAGE, "M212 374 V402 H641 V540 H678 V668"),
    (TRACE, "M962 684 V71 H1112"),
)


def architecture() -> str:
    """Return the picture as SVG."""
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" font-family="Helvetica, DejaVu Sans, sans-serif" '
        f'font-size="13" fill="{INK}">',
        "<title>The floors of rsltrace, the way of a message and the way of a trace</title>",
        "<defs>",
        *(_arrow_head(name, color) for name, color in (("message", MESSAGE), ("trace", TRACE))),
        "</defs>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="{PAPER}"/>',
        *_headings(),
        *(line for box in BOXES for line in _box(box)),
        *(line for box in OUTSIDE for line in _box(box, dashed=True)),
        *(_way(color, path) for color, path in WAYS),
        *(line for step in STEPS for line in _step(step)),
        "</svg>",
    ]
    return "\n".join(out) + "\n"


def _headings() -> list[str]:
    return [
        _text(180, 30, "imports go downwards only", size=12, color=FAINT),
        _text(16, 440, "1 to 7: the way of", color=MESSAGE),
        _text(16, 458, "one message into", color=MESSAGE),
        _text(16, 476, "the trace", color=MESSAGE),
        _text(1112, 130, "A to F: the way", color=TRACE),
        _text(1112, 148, "of a trace to", color=TRACE),
        _text(1112, 166, "a report", color=TRACE),
    ]


def _box(box: Box, *, dashed: bool = False) -> list[str]:
    dash = ' stroke-dasharray="5 4"' if dashed else ""
    fill = PAPER if dashed else box.fill
    return [
        f'<rect x="{box.x}" y="{box.y}" width="{box.width}" height="{box.height}" rx="6" '
        f'fill="{fill}" stroke="#9aa5b1"{dash}/>',
        _text(
            box.x + box.indent, box.y + min(22, box.height // 2 + 5), box.name, size=15, bold=True
        ),
        *(
            [_text(box.x + box.indent, box.y + 41, box.purpose, size=12, color=FAINT)]
            if box.purpose
            else []
        ),
    ]


def _step(step: Step) -> list[str]:
    first = step.y + 4 - 8 * (len(step.text) - 1) + (18 if step.mark == "1" else 0)
    return [
        f'<circle cx="{step.x}" cy="{step.y}" r="11" fill="{step.color}"/>',
        f'<text x="{step.x}" y="{step.y + 4}" text-anchor="middle" font-size="12" '
        f'font-weight="bold" fill="{PAPER}">{step.mark}</text>',
        *(
            _text(step.x + 17, first + 16 * number, line, size=12, color=step.color)
            for number, line in enumerate(step.text)
        ),
    ]


def _text(
    x: int, y: int, text: str, *, size: int = 13, color: str = INK, bold: bool = False
) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x}" y="{y}" font-size="{size}" fill="{color}"{weight}>{escape(text)}</text>'


def _way(color: str, path: str) -> str:
    head = "message" if color == MESSAGE else "trace"
    return (
        f'<path d="{path}" fill="none" stroke="{color}" stroke-width="2.5" opacity="0.75" '
        f'stroke-linejoin="round" marker-end="url(#{head})"/>'
    )


def _arrow_head(name: str, color: str) -> str:
    return (
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0 0 L8 4 L0 8 z" fill="{color}"/></marker>'
    )


if __name__ == "__main__":
    PICTURE.write_text(architecture(), encoding="utf-8")
