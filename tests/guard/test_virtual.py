"""Clocks, chance and directory listings answer from the simulation, wherever they are bound."""

from __future__ import annotations

import datetime
import errno
import json
import os
import random
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.guard import frames
from rsltrace.guard.callers import STANDARD, USER
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import Guard
from rsltrace.trace.model.finding import GuardPolicy
from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

Said = Callable[..., list[Any]]

# Bound long before any run, as in a module that a test suite has imported.
bound_before = time.time
table_before: dict[str, Callable[..., Any]] = {
    "clock": time.perf_counter_ns,
    "draw": random.random,
    "entropy": os.urandom,
}


@pytest.fixture(autouse=True)
def bound_methods() -> None:
    """Bound here: the garbage collector, which lists them, does not list what modules hold."""
    table_before["now"] = datetime.datetime.now


class Before(datetime.datetime):
    """A subclass made before the run."""


def with_default(clock: Callable[[], float] = time.monotonic) -> float:
    return clock()


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "expression",
    [
        "time.time()",
        "time.time_ns() / 1e9",
        "time.monotonic()",
        "time.monotonic_ns() / 1e9",
        "time.perf_counter()",
        "time.perf_counter_ns() / 1e9",
        "time.process_time()",
        "time.thread_time_ns() / 1e9",
        "time.clock_gettime(time.CLOCK_REALTIME)",
        "time.clock_gettime_ns(time.CLOCK_MONOTONIC) / 1e9",
        "t2()",
        "self.default()",
        "datetime.now(timezone.utc).timestamp()",
        "D.now(timezone.utc).timestamp()",
        "datetime.utcnow().replace(tzinfo=timezone.utc).timestamp()",
        "datetime.today().timestamp()",
        "sum(map(test.bound_before, ()), 0) + test.bound_before()",
        "test.table_before['now'](timezone.utc).timestamp()",
        "test.Before.now(timezone.utc).timestamp()",
        "test.with_default()",
        "test.table_before['clock']() / 1e9",
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_every_clock_shows_simulated_time(said: Said, expression: str) -> None:
    code = node_code(
        f"self.say({expression})",
        imports="import sys, time\nfrom time import time as t2\n"
        "from datetime import datetime, timezone\n"
        f"test = sys.modules[{__name__!r}]",
        module="class D(datetime): pass\n",
        init="self.default = lambda clock=time.perf_counter: clock()",
    )
    assert said(code) == [[0.5], [1.0]]


@pytest.mark.long
def test_broken_down_times_and_texts(said: Said) -> None:
    code = node_code(
        "self.say(time.gmtime()[:6], time.gmtime(None)[:6], time.gmtime(86400)[:3],\n"
        "         time.strftime('%M:%S'), time.strftime('%Y', (1999, *[1] * 8)),\n"
        "         time.ctime() == time.asctime() == time.ctime(time.time()), date.today().year)",
        imports="import time\nfrom datetime import date",
    )
    day = [1970, 1, 1, 0, 0]
    assert said(code) == [
        [[*day, 0], [*day, 0], [1970, 1, 2], "00:00", "1999", True, 1970],
        [[*day, 1], [*day, 1], [1970, 1, 2], "00:01", "1999", True, 1970],
    ]


DRAWS = """
[random.random(), random.gauss(0, 1), random.choice('abc'), random.getrandbits(70)],
[random.Random().random(), random.SystemRandom().random(), os.urandom(4).hex()],
[secrets.token_hex(4), str(uuid.uuid4()), str(uuid.uuid1()), uuid.getnode()],
[np.random.rand(), np.random.normal(), int(np.random.randint(1000))],
[np.random.default_rng().random(), np.random.RandomState().rand(), np.random.PCG64().random_raw()],
[test.table_before['draw'](), test.table_before['entropy'](3).hex()],
AT_IMPORT
"""


def drawing() -> str:
    return node_code(
        f"self.say({DRAWS})",
        imports="import os, random, secrets, sys, uuid\nimport numpy as np\n"
        f"test = sys.modules[{__name__!r}]",
        module="AT_IMPORT = [random.random(), os.urandom(2).hex(), int(np.random.randint(1000))]",
    )


@pytest.mark.long
def test_chance_is_the_same_in_every_run_and_different_for_every_seed(said: Said) -> None:
    first = said(drawing())
    random.random()
    np.random.rand()
    assert said(drawing()) == first
    assert len(first) == 2
    assert first[0][:4] != first[1][:4], "a stream goes on"
    other = said(drawing(), job="nodes: [{node: 'm:N'}]\nseed: 1")
    for group, group_other in zip(first[0], other[0], strict=True):
        for value, value_other in zip(group[:2], group_other[:2], strict=True):
            assert value != value_other


@pytest.mark.long
def test_one_more_node_does_not_disturb_the_others(said: Said) -> None:
    alone = said(drawing())
    extra = "nodes: [{node: 'm:N', name: first}, {node: 'm:N'}, {node: 'm:N', name: last}]"
    together = said(drawing(), job=extra)
    assert [together[1], together[4]] == alone
    assert together[0] != alone[0] != together[2]


@pytest.mark.long
def test_a_seed_of_the_nodes_own_is_its_own(said: Said) -> None:
    code = node_code(
        "self.say(random.random(), np.random.rand(), random.getstate()[1][0] > 0)",
        imports="import random\nimport numpy as np",
        init="random.seed(5); np.random.seed(5)",
    )
    expected = [random.Random(5).random(), np.random.RandomState(5).rand(), True]
    assert said(code)[0] == expected
    assert said(code, job="nodes: [{node: 'm:N', name: a}, {node: 'm:N'}]")[:2] == [expected] * 2


@pytest.mark.long
def test_busy_waiting_takes_simulated_time_and_ends(said: Said) -> None:
    code = node_code(
        "start = time.monotonic()\nwhile time.monotonic() - start < 0.02: pass\n"
        "self.say(time.monotonic() - start < 0.021)",
        imports="import time",
    )
    assert said(code) == [[True], [True]]


@pytest.mark.long
def test_directories_are_listed_in_the_order_of_names(said: Said, tmp_path: Path) -> None:
    folder = tmp_path / "many"
    folder.mkdir()
    names = [f"{random.getrandbits(40):x}" for _ in range(50)]
    for name in names:
        (folder / name).touch()
    code = node_code(
        f"f = {str(folder)!r}\n"
        "with os.scandir(f) as entries: scanned = [e.name for e in entries]\n"
        "self.say(os.listdir(f) == sorted(os.listdir(f)) == scanned\n"
        "    == [p.name for p in pathlib.Path(f).iterdir()] == next(os.walk(f))[2]\n"
        "    == [os.path.basename(p) for p in glob.glob(f + '/*')])",
        imports="import glob, os, pathlib",
    )
    assert said(code)[0] == [True]


def test_guard_false_leaves_everything_alone(said: Said) -> None:
    code = node_code("self.say(time.time() > 1e9, random.random())", imports="import random, time")
    off = "nodes: [{node: 'm:N'}]\nguard: false"
    first, second = said(code, job=off), said(code, job=off)
    assert first[0][0] is True
    assert first != second


@pytest.mark.long
def test_one_node_may_be_allowed_what_others_are_not(said: Said) -> None:
    code = node_code("self.say(time.time() > 1e9)", imports="import time")
    job = "nodes: [{node: 'm:N'}, {node: 'm:N', name: b, guard: {clock: allow}}]"
    assert said(code, job=job)[:2] == [[False], [True]]
    by_module = "nodes: [{node: 'm:N'}]\nguard: {clock: {allow: [m]}}"
    assert said(code, job=by_module)[0] == [True]


@pytest.mark.long
def test_a_main_may_be_allowed_what_others_are_not(said: Said) -> None:
    """Before it has made its node, in its callbacks and in its threads."""
    code = node_code(
        "self.say('callback', time.time() > 1e9)",
        imports="import rclpy, threading, time",
        init="threading.Thread(target=lambda: self.say('thread', time.time() > 1e9)).start()",
    )
    code += (
        "\ndef main():\n    early = time.time() > 1e9\n    rclpy.init()\n    node = N()\n"
        "    node.say('main', early)\n    try: rclpy.spin(node)\n"
        "    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException): pass\n"
    )
    job = "nodes: [{main: 'm:main', name: a, guard: {clock: allow}}, {main: 'm:main', name: b}]"
    found = said(code, job=job)
    assert found.count(["main", True]) == found.count(["main", False]) == 1
    assert found.count(["thread", True]) == found.count(["thread", False]) == 1
    assert found.count(["callback", True]) == found.count(["callback", False]) == 2


@pytest.mark.long
def test_nothing_is_left_after_a_run(said: Said) -> None:
    def state() -> list[object]:
        state = np.random.get_state()
        return [
            random.getstate(),
            state[1].tolist(),  # type: ignore[index,union-attr]
            random.Random.seed,
            np.random.seed,
            uuid._generate_time_safe,  # type: ignore[attr-defined]
            uuid._node,  # type: ignore[attr-defined]
            datetime.datetime.__dict__["now"],
            time.time.__self__,  # type: ignore[attr-defined]
            random.random.__self__,  # type: ignore[attr-defined]
            random.seed.__func__,  # type: ignore[attr-defined]
        ]

    before = state()
    said(drawing())
    with pytest.raises(Exception, match="boom"):
        said(node_code("raise RuntimeError('boom')"))
    assert state() == before
    assert abs(time.time() - time.clock_gettime(time.CLOCK_REALTIME)) < 5 < time.time()
    assert os.urandom(8) != os.urandom(8)
    assert random.Random().random() != random.Random().random()
    assert table_before["now"]().year > 2000


def test_libraries_work_under_the_guard(said: Said) -> None:
    for name in ("pandas", "scipy", "matplotlib"):
        pytest.importorskip(name)
    code = node_code(
        "figure = Figure(); figure.add_subplot().plot([1, 2], [3, 4])\n"
        "png = io.BytesIO(); figure.savefig(png, format='png')\n"
        "frame = pd.DataFrame({'x': np.random.rand(5)}, index=pd.date_range('2020', periods=5))\n"
        "self.say(str(pd.Timestamp.now()), frame.sample(2).x.tolist(),\n"
        "    scipy.stats.norm.rvs(size=2).tolist(), float(scipy.optimize.brentq(np.cos, 1, 2)),\n"
        "    hash(png.getvalue()) != 0)",
        imports="import io\nimport numpy as np\nimport pandas as pd\n"
        "import scipy.optimize, scipy.stats\n"
        "from matplotlib.figure import Figure",
    )
    first = said(code)
    assert first == said(code)
    assert first[0][0] == "1970-01-01 00:00:00.500000"


@pytest.mark.long
def test_the_generator_that_libraries_take_from_random_is_the_nodes_too(said: Said) -> None:
    """As networkx does: ``random._inst`` where no seed is given."""
    code = node_code(
        "shared = random._inst\n"
        "self.say(shared.random(), shared.sample(range(99), 3), shared.gauss(0, 1),\n"
        "    isinstance(shared, random.Random), random.random())",
        imports="import random",
    )
    before = random._inst  # type: ignore[attr-defined]
    first = said(code)
    random.random()
    assert said(code) == first
    assert said(code, job="nodes: [{node: 'm:N', name: a}, {node: 'm:N'}]")[1] == first[0]
    assert first[0][3] is True
    assert random._inst is before  # type: ignore[attr-defined]


def test_opencv_counts_simulated_time(said: Said) -> None:
    pytest.importorskip("cv2")
    code = node_code("self.say(cv2.getTickCount() / cv2.getTickFrequency())", imports="import cv2")
    assert said(code) == [[0.5], [1.0]]


@pytest.mark.long
def test_two_simulations_in_one_process_do_not_disturb_each_other(tmp_path: Path) -> None:
    import rsltrace

    (tmp_path / "twin.py").write_text(
        node_code(
            "self.say(time.time(), random.random(), os.urandom(2).hex(), float(np.random.rand()))",
            imports="import os, random, time\nimport numpy as np",
        )
    )

    def job() -> Any:
        return rsltrace.Job(
            nodes=[rsltrace.NodeSpec(node="twin:N")],
            search_path=[tmp_path],
            stop=rsltrace.StopSpec(duration="1.2s"),
        )

    alone = rsltrace.record(job(), tmp_path / "alone.mcap").digest
    with rsltrace.Simulation(job(), tmp_path / "one.mcap") as one:
        one.run_for("0.6s")
        assert time.time() > 1e9, "between steps the test's own clock is real"
        drawn = random.random(), os.urandom(4)
        one.run_for("1s")
        assert (random.random(), os.urandom(4)) != drawn
        one.run()
    assert one.result.digest == alone
    assert rsltrace.record(job(), tmp_path / "again.mcap").digest == alone


class Standing:
    """A simulation whose time the test sets, and the node that runs."""

    direct = None

    def __init__(self) -> None:
        self.time_ns = 0
        self.runs = "/a"

    def now_ns(self) -> int:
        return self.time_ns

    def look(self) -> tuple[int, str, int]:
        return *self.place()[:1], self.runs, self.time_ns

    def node(self) -> str:
        return self.runs

    def policy(self) -> None:
        return None

    def place(self) -> tuple[int, int]:
        return 0, 0

    def pass_time(self, for_ns: int) -> None:
        self.time_ns += for_ns


def _look(guard: Guard, frame: FrameType) -> int:
    return guard.clock_ns("a clock", USER, frame.f_globals)


@pytest.mark.long
@given(
    steps=st.lists(
        st.tuples(st.sampled_from("/a /b".split()), st.integers(0, 5_000) | st.just(10**9)),
        max_size=60,
    )
)
def test_no_clock_shows_the_same_twice(steps: list[tuple[str, int]]) -> None:
    """Nor goes back, nor depends on how often another node has looked, nor is far from the time."""
    frame = sys._getframe()

    def shown(nodes: str) -> list[int]:
        context, found = Standing(), []
        guard = Guard(context, policy=GuardPolicy())
        for node, advance_ns in steps:
            context.time_ns += advance_ns
            context.runs = node
            if node in nodes:
                found.append((node, _look(guard, frame), context.time_ns))
        assert all(0 <= clock_ns - now_ns <= 60_000 for _, clock_ns, now_ns in found)
        return [clock_ns for node, clock_ns, _ in found if node == "/a"]

    alone = shown("/a")
    assert alone == shown("/a /b".split())
    assert sorted(set(alone)) == alone


@pytest.mark.long
def test_a_clock_that_is_looked_at_for_ever_makes_time_pass(said: Callable[..., list[Any]]) -> None:
    """And what divides by a duration that took no simulated time works."""
    code = node_code(
        "start = time.perf_counter()\n"
        "rate = 1 / (time.perf_counter() - start)\n"
        "begun = time.time()\n"
        "while time.time() - begun < 0.003: pass\n"
        "self.say(rate, time.time() - begun, self.get_clock().now().nanoseconds)\n",
        imports="import time",
    )
    for n, (rate, waited, now_ns) in enumerate(said(code), 1):
        assert rate == pytest.approx(1e6, rel=1e-3)
        assert 0.003 <= waited < 0.0031
        assert 3_000_000 <= now_ns - n * 500_000_000 <= 3_100_000


def test_a_long_busy_wait_takes_few_events_and_ends_in_time() -> None:
    class Waiting(Standing):
        passes = 0

        def pass_time(self, for_ns: int) -> None:
            self.time_ns += for_ns
            self.passes += 1

    context = Waiting()
    guard = Guard(context, policy=GuardPolicy())
    frame = sys._getframe()
    while _look(guard, frame) < 10**9:
        pass
    assert 10**9 <= context.time_ns < 1.001 * 10**9
    assert context.passes < 5_000


def test_a_clock_that_jumps_backwards_is_followed() -> None:
    context = Standing()
    guard = Guard(context, policy=GuardPolicy())
    frame = sys._getframe()
    context.time_ns = 10**9
    assert [_look(guard, frame), _look(guard, frame)] == [10**9, 10**9 + 1_000]
    context.time_ns = 10**8
    assert [_look(guard, frame), _look(guard, frame)] == [10**8, 10**8 + 1_000]


def test_who_calls_is_known_after_a_handler_has_raised_while_it_was_asked() -> None:
    """A signal may come at any moment; what its handler raises goes through whoever runs."""

    def asked() -> FrameType:
        return caller()

    here = sys._getframe()
    assert asked() is here
    with pytest.raises(KeyboardInterrupt):
        frames.next_caller.__self__.throw(KeyboardInterrupt)  # type: ignore[attr-defined]
    assert asked() is here
    assert asked() is here


PROCESSORS = """
chosen = os.sched_getaffinity(0)
os.sched_setaffinity(0, {{3, 7}})
with ThreadPoolExecutor() as pool:
    workers = pool._max_workers
try:
    os.sched_setaffinity(0, [9])
except OSError as error:
    refused = error.errno
self.say(
    os.cpu_count(), sorted(chosen), sorted(os.sched_getaffinity(os.getpid())), refused,
    multiprocessing.cpu_count(), os.sysconf("SC_NPROCESSORS_ONLN"), workers,
    os.sysconf("SC_PAGE_SIZE") == {page},
)
"""


@pytest.mark.long
def test_every_machine_has_as_many_processors(said: Said) -> None:
    before = os.sched_getaffinity(0)
    imports = "import multiprocessing, os\nfrom concurrent.futures import ThreadPoolExecutor"
    code = node_code(PROCESSORS.format(page=os.sysconf("SC_PAGE_SIZE")), imports=imports)
    first, second = said(code)
    assert first == [4, [0, 1, 2, 3], [3], errno.EINVAL, 4, 4, min(32, 4 + 4), True]
    assert second[1] == [3], "as it was set"
    assert os.sched_getaffinity(0) == before
    real = node_code("self.say(os.cpu_count(), len(os.sched_getaffinity(0)))", imports="import os")
    job = "nodes: [{node: 'm:N'}]\nguard: {environment: allow}"
    assert said(real, job=job)[0] == [os.cpu_count(), len(before)]


@pytest.mark.long
def test_a_clock_that_is_given_something_refuses_it_as_ever(said: Said) -> None:
    code = node_code(
        "for call in (time.time, time.monotonic_ns, random.random):\n"
        "    try: call(1)\n"
        "    except TypeError as error: self.say(str(error))\n",
        imports="import random, time",
    )
    for (text,), name in zip(said(code), ("time", "monotonic_ns", "random"), strict=False):
        assert text.endswith(f".{name}() takes no arguments (1 given)")


def test_whose_code_reads_a_clock_is_told_from_its_file_and_not_from_its_modules() -> None:
    """A decorator's text is of no file, and what a program has compiled is of the file it says."""
    guard = Guard(Standing(), policy=GuardPolicy(), packages=frozenset(("pack",)))
    places = {"here": sys._getframe().f_code.co_filename, "json": json.__file__}

    def whose(name: str, file: str, **more: str) -> tuple[int, dict[str, int]]:
        names = {"whose": guard.file_kind, "frame": sys._getframe, "__file__": name, **more}
        exec(compile("kind = whose(globals(), frame())", file, "exec"), names)
        return names["kind"], guard.kinds  # type: ignore[return-value]

    assert whose(places["json"], "<text>") == (USER, {})
    assert whose(places["json"], places["here"]) == (USER, {})
    assert whose(places["json"], places["json"], __name__="__main__") == (STANDARD, {})
    assert whose(places["json"], places["json"]) == (STANDARD, {places["json"]: STANDARD})
    installed = "/x/site-packages/pack/node.py"
    assert whose(installed, installed, __name__="pack.node")[0] == USER
