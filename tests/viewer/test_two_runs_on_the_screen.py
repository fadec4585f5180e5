"""What the screens say of two runs is what the two traces say, read with the mcap package alone.

In the mode of one run its events stand there, all of them, in its order, with its numbers, times
and values, and nothing of the other. In the mode of both every event of both stands there, each run
in its order; a row that differs has both values; what moved points to its other place.
"""

from __future__ import annotations

import json
import re
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

DecoderFactory = pytest.importorskip("mcap_ros2.decoder").DecoderFactory

Drive = Callable[..., None]
SAMPLES = Path(__file__).parents[2] / "sample_traces"
NAMES = ("schedule", "delayed_input", "missing_event", "nondeterministic_callback")
MS = 1_000_000
_SHOWN = re.compile(r"(\S*) ?(\S+) → (\S+)")


@dataclass
class Read:
    """An event as it is in the file, with the values of its input and outputs."""

    index: int
    stamp_ns: int
    cause: tuple[int, int]
    values: set[str] = field(default_factory=set)
    outputs: list[set[str]] = field(default_factory=list)


def read(path: Path) -> list[Read]:
    """Read a trace without any code of rsltrace."""
    messages: dict[tuple[str, int], set[str]] = {}
    names: dict[int, tuple[str, int]] = {}
    events: list[Read] = []
    outputs: list[tuple[int, int, int, int]] = []
    with path.open("rb") as file:
        factory = DecoderFactory()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            data = message.data[4:]
            if channel.topic == "/rsltrace/events":
                _, index, stamp, cause, _, _, _, _, output, _, _, _ = struct.unpack(
                    "<QQQQQQQIIIBB", data
                )
                events.append(Read(index, stamp, (cause, output)))
            elif channel.topic == "/rsltrace/outputs":
                event, _, entity, kind, sequence = struct.unpack("<QQIII", data)
                outputs.append((event, entity, kind, sequence))
            else:
                decoder = factory.decoder_for(channel.message_encoding, schema)
                assert decoder is not None
                decoded = decoder(message.data)
                if channel.topic == "/rsltrace/entities":
                    names[decoded.id] = (decoded.name, decoded.kind)
                elif not channel.topic.startswith("/rsltrace/details"):
                    messages[channel.topic, message.sequence] = set(values_of(decoded))
    prefixes = {2: "/rsltrace/request", 3: "/rsltrace/response"}
    for event, entity, kind, sequence in outputs:
        topic = "/rosout" if kind == 4 else prefixes.get(kind, "") + names[entity][0]
        found = messages.get((topic, sequence), set()) if kind <= 4 else set()
        events[event].outputs.append(found)
        events[event].values |= found
    for one in events:
        cause, output = one.cause
        if cause < len(events) and output < len(events[cause].outputs):
            one.values |= events[cause].outputs[output]
    return events


def values_of(message: Any) -> Iterator[str]:
    """Yield all values in a message."""
    if hasattr(message, "__slots__"):
        for name in message.__slots__:
            yield from values_of(getattr(message, name))
    elif isinstance(message, (list, tuple)):
        for item in message:
            yield from values_of(item)
    else:
        yield str(message).lower() if isinstance(message, bool) else str(message)


def said(text: str, values: set[str]) -> bool:
    """Whether a value on the screen is one of these, as far as its digits go."""
    if text in values:
        return True
    try:
        number = float(text)
    except ValueError:
        return any(text.strip('"…') in value for value in values)
    digits = len(re.sub(r"e.*|[-.]", "", text).lstrip("0"))
    return any(
        float(f"{float(value):.{max(digits, 4)}g}") == number
        for value in values
        if re.fullmatch(r"-?[0-9.]+(e-?[0-9]+)?", value)
    )


@dataclass
class Row:
    """A line of the list of events."""

    sign: str
    numbers: tuple[int | None, ...]
    time_ns: int
    text: str
    unit_ns: int = 1
    """The digits of the time that there is room for."""

    def is_at(self, stamp_ns: int) -> bool:
        return self.time_ns == stamp_ns - stamp_ns % self.unit_ns


def rows_on(screen: str) -> list[Row]:
    """Return what the lines of the list say, by the places of its headings."""
    lines = screen.splitlines()
    top = next(n for n, line in enumerate(lines) if "what it did" in line)
    head = lines[top]
    what = head.index("what it did")
    two = re.match(r" +a +b +time", head) is not None
    ends = [head.index(" a ") + 2, head.index(" b ") + 2] if two else [head.index("event") + 5]
    found = []
    for line in lines[top + 1 :]:
        if not re.match(r"[>←→ ][=≠~+?-] ", line) or line.startswith(" ? help"):
            break
        starts = [4, *ends[:-1]]
        texts = [line[start:end].strip() for start, end in zip(starts, ends, strict=True)]
        time = line[ends[-1] :].split()[0]
        text = line[what:].partition("│")[0]
        text = re.sub(r" +[▁▂▃▄▅▆▇█]?$", "", text.rstrip())
        seconds, _, part = time.partition(".")
        assert len(part) in (6, 9), line
        unit_ns = 10 ** (9 - len(part))
        number = tuple(int(text) if text else None for text in texts)
        time_ns = int(seconds) * 10**9 + int(part) * unit_ns
        found.append(Row(line[1], number, time_ns, text, unit_ns))
    return found


def check_alone(rows: list[Row], own: list[Read], other: list[Read]) -> int:
    """Check the list of one run; return how many values were compared."""
    compared = 0
    assert [row.numbers for row in rows] == [(event.index,) for event in own]
    for row, event in zip(rows, own, strict=True):
        assert row.is_at(event.stamp_ns)
        for value in re.findall(r"[\w.ω]+=([^\s…\[]+)(?= |$)", row.text):
            assert said(value.strip(","), event.values), (row, event.values)
            compared += 1
        assert " → " not in row.text
        assert "only in" not in row.text
    return compared


def check_both(rows: list[Row], a: list[Read], b: list[Read]) -> dict[str, int]:
    """Check the list of both runs; return how many rows of which kind there were."""
    counts = {"moved": 0, "only": 0, "differs": 0, "same": 0, "values": 0}
    for side, events in enumerate((a, b)):
        assert [row.numbers[side] for row in rows if row.numbers[side] is not None] == [
            event.index for event in events
        ]
    at = [
        {
            row.numbers[side]: place
            for place, row in enumerate(rows)
            if row.numbers[side] is not None
        }
        for side in (0, 1)
    ]
    for place, row in enumerate(rows):
        i, j = row.numbers
        event = a[i] if i is not None else b[j or 0]
        assert row.is_at(event.stamp_ns)
        moved = re.search(r"([↓↑]) ([ab]) (\d+)", row.text)
        if moved:
            counts["moved"] += 1
            side = "ab".index(moved[2])
            assert row.numbers[side] is None
            there = at[side][int(moved[3])]
            assert (there > place) == (moved[1] == "↓")
            own = row.numbers[1 - side]
            back = f"{'↑' if moved[1] == '↓' else '↓'} {'ba'[side]} {own}"
            assert back in rows[there].text
            i, j = (own, int(moved[3])) if side else (int(moved[3]), own)
        elif row.sign in "-+":
            counts["only"] += 1
            assert row.text.startswith(f"only in {'a' if row.sign == '-' else 'b'}")
            assert row.numbers["-+".index(row.sign)] is not None
            assert row.numbers["+-".index(row.sign)] is None
            continue
        assert i is not None
        assert j is not None
        if row.sign == "≠":
            counts["differs"] += 1
            for _, x, y in _SHOWN.findall(row.text):
                if "…" not in x + y:
                    assert said(x, a[i].values), (row, a[i].values)
                    assert said(y.rstrip(","), b[j].values), (row, b[j].values)
                    assert x != y
                    counts["values"] += 1
        else:
            counts["same"] += 1
            assert a[i].values == b[j].values
            assert (a[i].stamp_ns == b[j].stamp_ns) or row.sign == "~"
    return counts


def screens(drive: Drive, pair: tuple[Path, Path]) -> tuple[list[list[Row]], list[list[Read]]]:
    """Return the rows of the modes of both, a and b, on a screen that holds all of them, and the
    events of the two traces."""
    traces = [read(path) for path in pair]
    height = sum(map(len, traces)) + 60
    found = []

    async def steps(viewer: Any) -> None:
        for _ in range(3):
            found.append(rows_on(viewer.text))
            await viewer.press("o")

    drive(pair, steps, size=(300, height))
    return found, traces


SIZES = ((80, 24), (120, 40), (200, 60))


def check_everywhere(drive: Drive, pair: tuple[Path, Path], folder: Path) -> None:
    """Check a pair on a screen that holds all of it, on screens of every size around the
    divergence, and in Rerun's recording."""
    found, (a, b) = screens(drive, pair)
    check_both(found[0], a, b)
    for size in SIZES:

        async def steps(viewer: Any) -> None:
            for keys in (["z"], ["pagedown"], ["z"], ["pageup"], ["end"]):
                await viewer.press(*keys)
                check_page(rows_on(viewer.text), found[0], a, b)

        drive(pair, steps, size=size)
    check_recording([row.numbers for row in found[0]], pair, (a, b), folder / "pair.rrd")


def check_page(page: list[Row], rows: list[Row], a: list[Read], b: list[Read]) -> None:
    """Check that a page is a part of the rows, with the values of their events."""
    assert page
    first = [row.numbers for row in rows].index(page[0].numbers)
    shown = rows[first : first + len(page)]
    assert [row.numbers for row in page] == [row.numbers for row in shown]
    for row, whole in zip(page, shown, strict=True):
        assert row.sign == whole.sign
        assert row.is_at(whole.time_ns)
        i, j = whole.numbers
        if moved := re.search(r"[↓↑] [ab] (\d+)", whole.text):
            i, j = (i, int(moved[1])) if j is None else (int(moved[1]), j)
            there = re.search(r"[↓↑] [ab] \d+ ", row.text)
            assert there is None or there[0] == moved[0] + " "
        for _, x, y in _SHOWN.findall(row.text) if None not in (i, j) else ():
            if "…" not in x + y and not row.text.endswith(y):
                assert said(x, a[i or 0].values), (row, whole)
                assert said(y.rstrip(","), b[j or 0].values), (row, whole)


def check_recording(
    rows: list[tuple[int | None, ...]],
    pair: tuple[Path, Path],
    events: tuple[list[Read], list[Read]],
    output: Path,
) -> None:
    """Check that a recording has the rows of the screen, and the events and values of the runs."""
    pytest.importorskip("rerun")
    from rsltrace_viewer.rerun_export.export import export

    from tests.rerun.recording import Recording

    export(pair, output)
    both = Recording(output)
    assert both.timelines == {"sim_time", "row"}
    for side, own in enumerate(events):
        table = sorted(both.rows[f"/run_{'ab'[side]}/events"], key=lambda row: row["row"])
        assert [row["number"] for row in table] == [[event.index] for event in own]
        assert [row["sim_time"] for row in table] == [event.stamp_ns for event in own]
        numbers = {row["row"]: row["number"][0] for row in table}
        assert numbers == {
            place: row[side] for place, row in enumerate(rows) if row[side] is not None
        }
        lanes = [path for path in both.rows if re.fullmatch(f"/lanes/.*/{'ab'[side]}", path)]
        busy = [
            row["row"]
            for path in lanes
            for row in both.rows[path]
            if row.get("row") is not None and row["StateChange:state"] != [""]
        ]
        assert sorted(busy) == sorted(numbers), "an event is in one lane, in its row"
        for path, found in both.rows.items():
            curve = re.fullmatch(rf"/run_{'ab'[side]}/topics/(?!rsltrace).*", path)
            for row in found if curve else ():
                values = {float(v) for v in own[numbers[row["row"]]].values if is_number(v)}
                for value in row.get("Scalars:scalars") or ():
                    assert value in values or value != value, (path, row)


def is_number(text: str) -> bool:
    return re.fullmatch(r"-?(inf|nan|[0-9.]+(e[-+]?[0-9]+)?)", text) is not None


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "missing_event" else pytest.mark.long)
        for name in NAMES
    ],
)
def test_samples_in_every_size_and_in_rerun(drive: Drive, name: str, tmp_path: Path) -> None:
    check_everywhere(drive, (SAMPLES / name / "a.mcap", SAMPLES / name / "b.mcap"), tmp_path)


@pytest.mark.parametrize(
    "name", [*(pytest.param(name, marks=pytest.mark.long) for name in NAMES[:2]), *NAMES[2:]]
)
def test_samples(drive: Drive, name: str) -> None:
    both, (a, b) = screens(drive, (SAMPLES / name / "a.mcap", SAMPLES / name / "b.mcap"))
    counts = check_both(both[0], a, b)
    compared = check_alone(both[1], a, b), check_alone(both[2], b, a)
    if name == "missing_event":
        assert counts["only"] > 30
    else:
        assert counts["values"] > 20
    assert min(compared) > 10 or name == "schedule"  # whose messages are single numbers
    assert (counts["moved"] > 100) == (name == "schedule")


@pytest.fixture(scope="session")
def simulator() -> Any:
    """The simulator that the tests of diff have."""
    if "diff_simulator" not in sys.modules:
        path = Path(__file__).parents[1] / "diff" / "simulate.py"
        spec = spec_from_file_location("diff_simulator", path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules["diff_simulator"] = module = module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules["diff_simulator"]


CASES = {
    "order": ("swap", {"which": 1}),
    "value": ("bit", {}),
    "missing": ("drop", {}),
    "more": ("extra", {}),
    "late": ("late", {"delay_ns": 5 * MS}),
}


@pytest.mark.few(4)
@pytest.mark.parametrize("case", [*CASES, "many moves"])
def test_constructed_pairs(drive: Drive, simulator: Any, tmp_path: Path, case: str) -> None:
    plan = simulator.NodePlan
    sent = simulator.Publication
    whole = simulator.Plan(
        (
            plan("/source", timers=((10 * MS, (sent("/a"),)),)),
            plan("/left", subscriptions=(("/a", (sent("/l"),)),), timers=((10 * MS, ()),)),
            plan("/right", subscriptions=(("/a", (sent("/r"),)),)),
            plan("/sum", subscriptions=(("/l", (sent("/s"),)), ("/r", (sent("/s"),)))),
        ),
        end_ns=200 * MS,
    )
    clean = simulator.Simulation(whole, tmp_path / "a.mcap").run()
    first = next(
        event.index
        for event in clean.log
        if event.index > 30
        and event.node == ("/source" if case == "late" else "/left")
        and event.name == ("tick" if case == "late" else "/a")
    )
    if case == "many moves":
        ticks = [e.index for e in clean.log if e.index > 30 and e.name == "/a"][::2]
        faults = [simulator.Fault("swap", index, which=1) for index in ticks]
    else:
        kind, more = CASES[case]
        faults = [simulator.Fault(kind, first, **more)]
    simulator.Simulation(whole, tmp_path / "b.mcap", tuple(faults)).run()
    found, (a, b) = screens(drive, (tmp_path / "a.mcap", tmp_path / "b.mcap"))
    counts = check_both(found[0], a, b)
    pair = tmp_path / "a.mcap", tmp_path / "b.mcap"
    check_recording([row.numbers for row in found[0]], pair, (a, b), tmp_path / "pair.rrd")
    assert check_alone(found[1], a, b) > 20
    assert check_alone(found[2], b, a) > 20
    expected = {
        "order": "moved",
        "many moves": "moved",
        "value": "values",
        "missing": "only",
        "more": "only",
        "late": "moved",
    }
    assert counts[expected[case]] >= (10 if case == "many moves" else 1), json.dumps(counts)


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (200, 60)])
def test_a_difference_can_be_read_in_every_size(drive: Drive, size: tuple[int, int]) -> None:
    """Also at 80 columns both numbers, the place in the other run and both values are there."""
    folder = SAMPLES / "schedule"

    async def steps(viewer: Any) -> None:
        if size == (80, 24):
            await viewer.press("z")
        lines = viewer.text.splitlines()
        here, there = (line for line in lines if "-1.148 → -0.5748" in line)
        assert re.match(r">≠ +5 +0.020000", here)
        assert "↓ a 7" in here
        assert re.match(r" ≠ +7 +0.020000", there)
        assert "↑ b 5" in there

    drive((folder / "a.mcap", folder / "b.mcap"), steps, size=size)


def test_what_depends_on_rows_stands_on_events_of_the_run_that_is_shown(drive: Drive) -> None:
    folder = SAMPLES / "schedule"
    pair = folder / "a.mcap", folder / "b.mcap"
    a, b = (read(path) for path in pair)

    async def steps(viewer: Any) -> None:
        app, session = viewer.app, viewer.app.session

        def selected() -> tuple[bool, int]:
            run, index = session.current()
            return run is session.b, index

        # Both: the row of b alone comes first, its link leads to the same event of a.
        assert selected() == (True, 5)
        await viewer.press("enter")
        while "stands below" not in app.inspector.current.value:
            await viewer.press("down")
        await viewer.press("enter")
        assert selected() == (False, 7)
        await viewer.press("b", "escape")
        assert selected() == (True, 5)
        # b alone: the next event of the node, a filter, a search, a number, a time, a mark.
        await viewer.press("o", "o")
        assert selected() == (True, 5)
        await viewer.press("m", "right_square_bracket")
        assert "controller" in session.own_lane()
        after = selected()[1]
        assert after > 5
        await viewer.press("i")
        await viewer.type("100")
        assert selected() == (True, 100)
        await viewer.press("t")
        await viewer.type("1")
        first = next(event.index for event in b if event.stamp_ns >= 10**9)
        assert selected() == (True, first)
        await viewer.press("quotation_mark")
        assert selected() == (True, 5)
        await viewer.press("F")
        await viewer.type("node:/controller kind:timer")
        shown = [row.numbers[0] for row in rows_on(viewer.text)]
        kinds = {int(session.b.row(index)["kind"]) for index in shown if index is not None}
        assert kinds == {2}
        await viewer.press("o")  # both, with the filter: the timers of both
        assert session.filter_text
        places = [session.rows.at(row) for row in range(session.rows.count)]
        for name, run in session.runs.items():
            events = {session.view.a(p) if name == "a" else session.view.b(p) for p in places}
            wanted = {
                index
                for index in range(run.count)
                if int(run.row(index)["kind"]) == 2
                and run.node_name(int(run.row(index)["entity"])) == "/controller"
            }
            assert events - {None} >= wanted
        assert len(places) == len(set(places))
        assert places == sorted(places)
        assert len(a) == session.a.count

    drive(pair, steps, size=(200, 60))
