"""Whatever goes through a set of objects: the same in every process, or a finding at its line."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rsltrace.trace.model.finding import NondeterminismSource
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

SOURCE = """
import array, asyncio, collections, concurrent.futures, copy, dataclasses, functools, heapq
import itertools, json, operator, os
import pickle, random, statistics, string, sys, types, typing, weakref
import numpy as np
from rclpy.node import Node

class Task:
    def __init__(self, name, rank=0):
        self.name, self.rank = name, rank
    def __repr__(self):
        return self.name
    def __lt__(self, other):
        return self.rank < other.rank

class Slim:
    __slots__ = ("name",)
    def __init__(self, name):
        self.name = name

@dataclasses.dataclass(frozen=True)
class Cell:
    owner: Task
    def __repr__(self):
        return self.owner.name

@dataclasses.dataclass
class Plan:
    tasks: set = dataclasses.field(default_factory=set)

class Own:
    def __init__(self, name):
        self.name = name
    def __hash__(self):
        return object.__hash__(self) >> 4

class Above(Own):
    def __hash__(self):
        return super().__hash__() + 1

class Fleet(set):
    pass

Pair = collections.namedtuple("Pair", "task number")
JUNK = [Task(str(i)) for i in range(len(os.environ.get("PAD", "")))]
del JUNK[::2]

def names(things):
    return [getattr(one, "name", one) for one in things]

def tasks():
    return {Task(f"t{i}", i % 2) for i in range(9)}

def collect(*things, **named):
    return names(things)

async def later(number):
    await asyncio.sleep(0.01 * (number % 2))
    return number

async def waited():
    done, _ = await asyncio.wait([asyncio.ensure_future(later(n)) for n in range(6)])
    return [task.result() for task in done]

async def completed():
    return [await one for one in asyncio.as_completed([later(n) for n in range(6)])]

def pooled():
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        calls = [pool.submit(pow, n, 2) for n in range(9)]
        done = concurrent.futures.wait(calls).done
    return [one.result() for one in (*done, *concurrent.futures.as_completed(calls))]

def added(things):
    found = []
    found += things
    found[2:4] = things
    return names(found)

def taken_apart(things):
    first, second, *others = things
    return names([second, *others, first])

def given(kind):
    return {kind(f"k{i}") for i in range(9)}

"""

LINES = """
names(sorted(s, key=lambda t: t.rank))
names(sorted(s))
names(sorted(s, key=lambda t: t.rank, reverse=True))
names(list(s))
names(tuple(s))
names([*s])
names((*s, 1))
names(s)
[t.name for t in s]
names({**dict.fromkeys(s)})
names(dict.fromkeys(s, 1))
names({t: 1 for t in s})
names(dict(zip(s, s)))
names(collections.Counter(s))
names(collections.deque(s))
names(collections.deque(s, 3))
names(collections.OrderedDict.fromkeys(s))
names(collections.ChainMap(dict.fromkeys(s)))
names(heapq.nsmallest(4, s, key=lambda t: t.rank))
names(heapq.nlargest(4, s, key=lambda t: t.rank))
names(heapq.merge(s, [], key=lambda t: t.rank))
names(itertools.chain(s, s))
names(itertools.chain.from_iterable([s]))
[k + str(names(g)) for k, g in itertools.groupby(s, key=lambda t: str(t.rank))]
str([*itertools.product(s, repeat=2)])
str([*itertools.permutations(s, 2)])
str([*itertools.combinations(s, 2)])
str([*itertools.combinations_with_replacement(s, 2)])
names(itertools.islice(s, 4))
[*itertools.accumulate(s, lambda a, b: f"{a}{b}", initial="")]
names(itertools.tee(s)[1])
names(itertools.islice(itertools.cycle(s), 12))
names(itertools.takewhile(lambda t: t.rank, s))
names(itertools.dropwhile(lambda t: t.rank, s))
names(itertools.compress(s, [1, 0] * 4))
names(itertools.filterfalse(lambda t: t.rank, s))
[*itertools.starmap(str, zip(s))]
str([*itertools.zip_longest(s, "ab")])
[*map(str, s)]
names(filter(None, s))
str([*zip(s, range(9))])
str([*enumerate(s)])
names(map(next, [iter(s)]))
next(iter(s)).name
min(s, key=lambda t: t.rank).name
max(s, key=lambda t: t.rank).name
max(s, default=None).name
" ".join(map(str, s))
" ".join(t.name for t in s)
functools.reduce(lambda a, b: f"{a}{b}", s)
sum((names([t]) for t in s), [])
names(random.Random(1).sample(list(s), 4))
random.Random(2).choice(tuple(s)).name
(lambda r: (random.Random(3).shuffle(r), names(r)))(list(s))[1]
statistics.mode(s).name
names(statistics.multimode(s))
names(np.array(list(s)))
names(np.fromiter(s, object))
collect(*s)
collect(0, *s, 1)
collect(**{t.name: 1 for t in s})
(lambda r: r.extend(s) or names(r))([])
(lambda r: operator.iadd(r, s) and names(r))([])
(lambda r: r.__iadd__(s) and names(r))([])
(lambda r: r.__setitem__(slice(0, 1), s) or names(r))([1, 2])
(lambda r: r.extend(s) or names(r))(collections.deque())
(lambda r: [*map(r.extend, [s])] and names(r))([])
[*map(" ".join, [{"b", "a", "c", *map(str, s)}])]
operator.concat(list(s), [1])[0].name
(lambda r: r.update(dict.fromkeys(s)) or names(r))({})
(lambda r: [r.pop().name for _ in range(4)])(set(s))
(lambda r: names([*map(set.pop, [r] * 3)]))(set(s))
(lambda r: names(operator.methodcaller("pop")(r) for _ in "abc"))(set(s))
(lambda a, b, *c: names([a, b, *c]))(*s)
(lambda it: [next(it).name for _ in range(3)])(iter(s))
list(s)[0].name
s.__iter__().__next__().name
f"{s}"
str(s)
repr(s)
"%s" % (s,)
"{}".format(s)
string.Template("$s").substitute(s=s)
json.dumps({"s": s}, default=names)
str(Plan(s))
names(Plan(s).tasks)
names(dataclasses.asdict(Plan(s))["tasks"])
str(pickle.dumps(s))
str(pickle.dumps({"s": [s]}, 5))
str(pickle.dumps(s, 2))
names(pickle.loads(pickle.dumps(s)))
names(copy.copy(s))
names(copy.deepcopy(s))
names(s.copy())
names(frozenset(s))
names(s | {Task("x")})
names(s - {1})
names(s & s)
names(s ^ {Task("y")})
names(s.union([Task("z")]))
names(dict.fromkeys(s).keys() - {1})
names(dict.fromkeys(s).keys() & s)
names(set().union(*[[t] for t in s]))
names(Fleet(s))
names(sorted(Fleet(s), key=lambda t: t.rank))
names(weakref.WeakSet(s))
[weakref.WeakSet(s).pop() is None, len(s)]
(lambda w: names([w.pop(), w.pop()]))(weakref.WeakSet(s))
names(one() for one in {weakref.ref(t) for t in s})
[str(a) for a in {Task | Slim, Task | int, int | str}]
str({(t, 1) for t in s})
str(sorted({(t.rank, t) for t in s}, key=lambda p: p[0]))
str({Pair(t, 1) for t in s})
str({frozenset([t]) for t in s})
str({Cell(t) for t in s})
names(given(Slim))
names(sorted(given(Slim), key=lambda t: 0))
names(given(Own))
names(given(Above))
[f() for f in {(lambda i=i: i) for i in range(9)}]
[f() for f in {functools.partial(str, i) for i in range(9)}]
[f.__name__ for f in {abs, len, max, min, sum, ord}]
[f.__self__.name for f in {t.__repr__ for t in s}]
[f.__name__ for f in {(5).__add__, (3).__repr__, "a".upper, "b".upper, [].append}]
[k.__name__ for k in {Task, Slim, Cell, Own, Fleet, int, str, dict}]
[m.__name__ for m in {json, os, sys, heapq}]
[str(a) for a in {list[Task], list[Slim], dict[str, Task]}]
[[*g] for g in {(i for i in [n]) for n in range(6)}]
[len([*g]) for g in {(i for i in range(n)) for n in range(6)}]
[type(o).__name__ for o in {object() for _ in range(6)}]
(lambda r: [r.index(o) for o in {*r}])([object() for _ in range(9)])
(lambda r: [r.index(o) for o in sorted({*r}, key=lambda o: 0)])([Slim("a") for _ in range(9)])
(lambda r: [r.index(o) for o in heapq.nlargest(4, {*r}, key=lambda o: 0)])(list(map(Slim, "a" * 9)))
(lambda r: [r.index(o) for o in list(map(list, [{*r}]))[0]])([object() for _ in range(9)])
(lambda r: r.index({*r}.pop()))([object() for _ in range(9)])
hash(object())
object().__hash__()
object.__hash__(Task("a"))
[*map(object.__hash__, [Task("a")])]
Task("a").__hash__() % 64
id(Task("a"))
names(map(sorted, [s])) and names([*map(sorted, [s])][0])
names([*map(list, [s])][0])
names([*map(tuple, [s])][0])
names(functools.partial(sorted, key=str)(s)[:2])
names(array.array("i", [t.rank for t in s]))
names(typing.cast(set, s))
eval("[t.name for t in s]", {"s": s})
(lambda d: exec("a, *b = s\\nr = list(s)\\nr.extend(s)\\nr[1:2] = s", d) or names(d["r"]))({"s": s})
asyncio.run(waited())
asyncio.run(completed())
pooled()
added(s)
taken_apart(s)
names(vars(types.SimpleNamespace(s=s))["s"])
names(operator.itemgetter(0)([s]))
""".strip().splitlines()

NODE = """

class N(Node):
    def __init__(self):
        super().__init__("n")
        self.left = [name for name in globals() if name.startswith("case_")]
        self.create_timer(0.001, self.tick)
    def tick(self):
        if self.left:
            case = self.left.pop()
            said = globals()[case](tasks())
            self.get_logger().info(json.dumps([case, said], default=str))
"""


_LINES_BEFORE = SOURCE.count("\n")


def _recorded(
    folder: Path, turn: int
) -> tuple[dict[str, str], dict[str, set[NondeterminismSource]]]:
    """Return what each line gave, and the sources of the findings in it."""
    path = folder / f"{'long' * turn}{turn}.mcap"
    environment = {**os.environ, "PAD": "x" * (37 + 411 * turn)}
    words = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-q", "-o", path.name]
    subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True, timeout=300)
    found: dict[str, set[NondeterminismSource]] = {}
    with Trace.open(path) as trace:
        texts = [trace.decode("/rosout", data).msg for *_, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
        for findings in trace.findings.values():
            for one in findings:
                line = re.match(r"m\.py:(\d+) in ", one.stack)
                if line and int(line[1]) > _LINES_BEFORE:
                    found.setdefault(f"case_{(int(line[1]) - _LINES_BEFORE - 1) // 2}", set()).add(
                        one.source
                    )
    return dict(json.loads(text) for text in texts if text.startswith("[")), found


@pytest.fixture(scope="module")
def runs(
    tmp_path_factory: pytest.TempPathFactory,
) -> list[tuple[dict[str, str], dict[str, set[NondeterminismSource]]]]:
    folder = tmp_path_factory.mktemp("lines")
    cases = [f"def case_{number}(s):\n    return {line}\n" for number, line in enumerate(LINES)]
    (folder / "m.py").write_text("".join((SOURCE, *cases, NODE)))
    (folder / "job.yaml").write_text("nodes: [{node: 'm:N'}]\nstop: {duration: 0.7s}\n")
    return [_recorded(folder, turn) for turn in range(3)]


@pytest.mark.parametrize("number", range(len(LINES)), ids=[line[:50] for line in LINES])
def test_a_line_gives_the_same_in_every_process_or_a_finding(
    runs: list[tuple[dict[str, str], dict[str, set[NondeterminismSource]]]], number: int
) -> None:
    case = f"case_{number}"
    said = [json.dumps(texts[case]) for texts, _ in runs]
    assert len(said) == 3
    if len(set(said)) > 1:
        assert all(found.get(case) for _, found in runs), f"silent: {said}"
