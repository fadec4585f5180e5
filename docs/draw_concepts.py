"""The drawings of ``docs/concepts``: ``make docs`` writes them, a test fails when one is stale.

They are dark cards, as the pictures of the viewer are, and so legible on light and dark pages. What
they show happens in ``examples/cart``, at 6.6 s.
"""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path

PICTURES = Path(__file__).resolve().parent / "pictures"
BACK, CARD, LINE, TEXT, DIM = "#1b2028", "#262e3a", "#51607a", "#e8ecf2", "#a3b0c2"
BLUE, ORANGE, GREEN, RED = "#6fb1f0", "#f0a860", "#7cc78f", "#ee8aa0"


def text(
    x: int, y: int, words: str, colour: str = TEXT, size: int = 14, anchor: str = "start"
) -> str:
    """Return a line of text."""
    at = f'x="{x}" y="{y}" fill="{colour}" font-size="{size}" text-anchor="{anchor}"'
    return f"<text {at}>{escape(words)}</text>"


def box(x: int, y: int, width: int, title: str, *rows: str, colour: str = BLUE) -> str:
    """Return a box with a title and rows below it."""
    height = 34 + 20 * len(rows)
    shape = f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="6" '
    parts = [f'{shape}fill="{CARD}" stroke="{colour}" stroke-width="1.5"/>']
    parts.append(text(x + 12, y + 22, title, colour))
    parts += [text(x + 12, y + 43 + 20 * n, row, TEXT, 13) for n, row in enumerate(rows)]
    return "\n".join(parts)


def arrow(*points: tuple[int, int], colour: str = DIM) -> str:
    """Return a line through these points, with a head at its end."""
    way = " ".join(f"{x},{y}" for x, y in points)
    style = f'fill="none" stroke="{colour}" stroke-width="2" marker-end="url(#{colour[1:]})"'
    return f'<polyline points="{way}" {style}/>'


def card(width: int, height: int, title: str, *parts: str) -> str:
    """Return a whole drawing."""
    heads = "".join(
        f'<marker id="{colour[1:]}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        f'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
        for colour in (DIM, BLUE, ORANGE, GREEN, RED)
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
            "font-family=\"system-ui, 'DejaVu Sans', sans-serif\">",
            f"<title>{escape(title)}</title><defs>{heads}</defs>",
            f'<rect width="{width}" height="{height}" rx="8" fill="{BACK}"/>',
            *parts,
            "</svg>\n",
        ]
    )


def loop() -> str:
    """Draw the loop: what is ready, one choice, one callback, what comes of it."""
    return card(
        760,
        300,
        "The loop takes one ready callback at a time; when none is ready, simulated time jumps",
        box(24, 40, 210, "ready at 6.600 s", "/driver: /obstacle", "/driver: timer drive"),
        box(24, 190, 210, "due later", "6.650  /wheels: timer roll", "6.700  /scanner: timer scan"),
        box(
            280,
            40,
            190,
            "policy",
            "takes one: first come,",
            "first served, timers last",
            colour=ORANGE,
        ),
        box(520, 40, 216, "one callback", "runs to its end, alone;", "no simulated time passes"),
        box(
            520,
            190,
            216,
            "its outputs",
            "/speed goes to /wheels:",
            "one more is ready",
            colour=GREEN,
        ),
        arrow((234, 77), (278, 77)),
        arrow((470, 77), (518, 77)),
        arrow((628, 116), (628, 188)),
        arrow((520, 245), (275, 245), (275, 140), (129, 140), (129, 118), colour=GREEN),
        arrow((60, 190), (60, 118), colour=ORANGE),
        text(286, 262, "ready at once, or later with a delay", DIM, 12),
        text(70, 166, "nothing ready: time jumps", ORANGE, 12),
    )


def event() -> str:
    """Draw an event: what it got, what it put out, and the hashes of both."""
    return card(
        760,
        250,
        "Event 486: a callback, its input, its outputs and their hashes",
        box(24, 70, 170, "input", "a timer that is due,", "or a message's bytes", colour=GREEN),
        box(
            250,
            40,
            250,
            "event 486",
            "time    6.600000000 s",
            "node    /scanner",
            "what    timer Scanner.scan",
        ),
        box(560, 40, 176, "output 0", "message on /range", colour=ORANGE),
        box(560, 130, 176, "output 1", "message on /obstacle", colour=ORANGE),
        arrow((194, 107), (248, 107)),
        arrow((500, 70), (558, 70)),
        arrow((500, 110), (530, 110), (530, 157), (558, 157)),
        text(109, 215, "input hash", GREEN, 13, "middle"),
        text(375, 215, "which entity of which node, when", BLUE, 13, "middle"),
        text(648, 215, "output hash", ORANGE, 13, "middle"),
    )


def chain() -> str:
    """Draw the chain hashes of two runs that agree up to event 486."""
    parts = []
    for n, number in enumerate((484, 485, 486, 487, 488)):
        x = 70 + 136 * n
        same = number < 487
        for y, colour in ((50, BLUE), (150, BLUE if same else RED)):
            parts.append(box(x, y, 104, str(number), "chain hash", colour=colour))
            if n:
                parts.append(arrow((x - 32, y + 27), (x - 2, y + 27), colour=colour))
        parts.append(text(x + 52, 132, "=" if same else "≠", GREEN if same else RED, 18, "middle"))
    return card(
        760,
        280,
        "Each chain hash covers all events before it, so two runs agree up to where they are equal",
        text(24, 82, "good", TEXT, 13),
        text(24, 182, "bad", TEXT, 13),
        *parts,
        text(24, 242, "chain hash of an event = hash of it and the chain hash before it", DIM, 13),
        text(24, 262, "digest of a run = its last chain hash", DIM, 13),
    )


def cause() -> str:
    """Draw what came of one event."""
    rows = (
        (40, "484  /wheels", "timer Wheels.roll", "/position", "485  /scanner"),
        (120, "486  /scanner", "timer Scanner.scan", "/obstacle", "487  /driver"),
        (200, "488  /driver", "timer Driver.drive", "/speed", "489  /wheels"),
    )
    return card(
        760,
        280,
        "What event 484 led to: each event names the output of another event that it came from",
        *(
            box(x, y, 200, title, what)
            for y, timer, name, topic, other in rows
            for x, title, what in ((24, timer, name), (290, other, f"subscription {topic}"))
        ),
        *(arrow((224, y + 27), (288, y + 27), colour=ORANGE) for y, *_ in rows),
        *(text(230, y + 18, topic, ORANGE, 11) for y, _, _, topic, _ in rows),
        text(516, 66, "what was published", DIM, 13),
        text(516, 84, "caused what received it", DIM, 13),
        text(516, 146, "timers come from time alone:", DIM, 13),
        text(516, 164, "they begin a chain", DIM, 13),
    )


def guard() -> str:
    """Draw what becomes of calls whose answers differ from run to run."""
    return card(
        760,
        270,
        "The guard makes calls deterministic, records their answers, or reports them",
        box(24, 105, 190, "your node calls", "something whose answer", "differs from run to run"),
        box(
            300,
            24,
            436,
            "made by the run",
            "time.time, random, uuid4, os.listdir, the order of sets",
            colour=GREEN,
        ),
        box(
            300,
            108,
            436,
            "recorded (mode record)",
            "answers are kept in the trace, and given again",
            colour=ORANGE,
        ),
        box(
            300,
            192,
            436,
            "reported",
            "files, sockets, processes: the diff names the line",
            colour=RED,
        ),
        arrow((214, 130), (255, 130), (255, 51), (298, 51), colour=GREEN),
        arrow((214, 137), (298, 137), colour=ORANGE),
        arrow((214, 144), (255, 144), (255, 219), (298, 219), colour=RED),
    )


DRAWINGS: dict[str, Callable[[], str]] = {
    "concept_loop.svg": loop,
    "concept_event.svg": event,
    "concept_chain.svg": chain,
    "concept_cause.svg": cause,
    "concept_guard.svg": guard,
}

if __name__ == "__main__":
    for name, draw in DRAWINGS.items():
        (PICTURES / name).write_text(draw(), "utf-8")
