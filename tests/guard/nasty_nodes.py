"""Nodes that are not deterministic, one source each. ``CASES`` says what the guard makes of each.

A case is a piece of code that returns what it saw; its node logs that every half second.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import ctypes
import dataclasses
import enum
import functools
import gc
import glob
import heapq
import json
import locale
import logging
import multiprocessing
import os
import pathlib
import pickle
import queue
import random
import resource
import secrets
import select
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import timeit
import traceback
import uuid
import weakref
from collections.abc import Callable
from contextlib import closing
from datetime import date, datetime, timezone
from random import random as drawn_directly
from time import time as from_import
from typing import Any

import numpy as np
from rclpy.node import Node

DETERMINISTIC, DETECTED = "made deterministic", "detected"
CASES: dict[str, tuple[str, str, Callable[[Any], object]]] = {}
"""By name: what the guard makes of it, what it is, and the code."""

AT_IMPORT = (time.time_ns(), random.random())


def case(expected: str, what: str) -> Callable[[Callable[[Any], object]], Callable[[Any], object]]:
    def add(function: Callable[[Any], object]) -> Callable[[Any], object]:
        CASES[function.__name__] = (expected, what, function)
        return function

    return add


PARTIAL = functools.partial(time.time_ns)


@dataclasses.dataclass
class Stamped:
    """A message with the time it was made."""

    stamp: float = dataclasses.field(default_factory=time.time)


class Way(enum.Enum):
    NORTH, EAST, SOUTH, WEST, UP, DOWN = "north", "east", "south", "west", "up", "down"


class Thing:
    """Hashed and shown by its address."""


class Caller:
    """Hashed by its address, and so are its methods."""

    def __init__(self, number: int) -> None:
        self.number = number

    def call(self) -> int:
        return self.number


class Dated(datetime):
    """A subclass of datetime."""


class Dying:
    def __init__(self, last_words: list[object]) -> None:
        self.last_words, self.myself = last_words, self

    def __del__(self) -> None:
        self.last_words.append(time.time_ns())


# -- clocks ---------------------------------------------------------------------------------------


@case(DETERMINISTIC, "`time.time()`")
def time_time(node: Any) -> object:
    return time.time()


@case(DETERMINISTIC, "`from time import time`")
def time_from_import(node: Any) -> object:
    return from_import()


@case(DETERMINISTIC, "a clock as a default argument")
def time_default_argument(node: Any, clock: Callable[[], float] = time.monotonic) -> object:
    return clock()


@case(DETERMINISTIC, "a clock in a table")
def time_in_a_table(node: Any) -> object:
    return {"clock": time.perf_counter_ns}["clock"]()


@case(DETERMINISTIC, "a measured duration (`time.perf_counter`)")
def measured_duration(node: Any) -> object:
    start = time.perf_counter()
    sum(range(10_000))
    return time.perf_counter() - start


@case(DETERMINISTIC, "processor time (`time.process_time`)")
def process_time(node: Any) -> object:
    return time.process_time()


@case(DETERMINISTIC, "`time.strftime` of now")
def strftime(node: Any) -> object:
    return time.strftime("%H:%M:%S"), time.gmtime()[:6]


@case(DETERMINISTIC, "`time.clock_gettime`")
def clock_gettime(node: Any) -> object:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC)


@case(DETERMINISTIC, "a clock read at import")
def read_at_import(node: Any) -> object:
    return AT_IMPORT


@case(DETERMINISTIC, "`datetime.now`, `utcnow`, `today`")
def datetime_now(node: Any) -> object:
    return datetime.now(timezone.utc), datetime.today(), date.today().year


@case(DETERMINISTIC, "`now` of a subclass of `datetime`")
def datetime_subclass(node: Any) -> object:
    return Dated.now()


@case(DETERMINISTIC, "a busy wait")
def busy_wait(node: Any) -> object:
    start = time.monotonic_ns()
    while time.monotonic_ns() - start < 1_000_000:
        pass
    return time.monotonic_ns() - start


@case(DETERMINISTIC, '`np.datetime64("now")`')
def numpy_now(node: Any) -> object:
    return np.datetime64("now")


@case(DETERMINISTIC, "a clock as the `default_factory` of a dataclass's field")
def default_factory(node: Any) -> object:
    return Stamped().stamp


@case(DETERMINISTIC, "a clock in a `functools.partial`")
def clock_in_a_partial(node: Any) -> object:
    return PARTIAL()


@case(DETERMINISTIC, "`datetime.now` as a default argument")
def datetime_default_argument(node: Any, now: Callable[[], datetime] = datetime.now) -> object:
    return now()


@case(DETERMINISTIC, "the time of a `logging` record")
def log_record_time(node: Any) -> object:
    record = logging.LogRecord("x", logging.INFO, "f", 1, "m", (), None)
    return record.created, record.relativeCreated, logging.Formatter("%(asctime)s").format(record)


@case(DETERMINISTIC, "a measured time (`timeit`)")
def timed(node: Any) -> object:
    return timeit.timeit("1 + 1", number=100)


@case(DETERMINISTIC, "waiting with `select` alone")
def waiting_in_select(node: Any) -> object:
    start = time.monotonic_ns()
    select.select([], [], [], 0.01)
    return time.monotonic_ns() - start


@case(DETERMINISTIC, "the local time zone")
def time_zone(node: Any) -> object:
    return time.localtime(1e9)[:5], time.tzname


@case(DETECTED, "SQLite's clock")
def sqlite_clock(node: Any) -> object:
    with closing(sqlite3.connect(":memory:")) as connection:
        return connection.execute("SELECT strftime('%f', 'now')").fetchall()


@case(DETECTED, "a clock of the C library through `ctypes`")
def ctypes_clock(node: Any) -> object:
    return ctypes.CDLL(None).clock()


@case(DETECTED, "`os.times`")
def os_times(node: Any) -> object:
    return os.times()


@case(DETECTED, "`resource.getrusage`")
def rusage(node: Any) -> object:
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime


# -- chance ---------------------------------------------------------------------------------------


@case(DETERMINISTIC, "`random.random` and its like")
def random_functions(node: Any) -> object:
    return random.random(), random.gauss(0, 1), random.sample(range(99), 3)


@case(DETERMINISTIC, "`from random import random`")
def random_from_import(node: Any) -> object:
    return drawn_directly()


@case(DETERMINISTIC, "`random.Random()` without a seed")
def random_unseeded(node: Any) -> object:
    return random.Random().random()


@case(DETERMINISTIC, "`random.SystemRandom`")
def system_random(node: Any) -> object:
    return random.SystemRandom().random()


@case(DETERMINISTIC, "`os.urandom`")
def os_urandom(node: Any) -> object:
    return os.urandom(8).hex()


@case(DETERMINISTIC, "`secrets`")
def secrets_token(node: Any) -> object:
    return secrets.token_hex(8), secrets.randbelow(10**9)


@case(DETERMINISTIC, "`uuid.uuid4`")
def uuid4(node: Any) -> object:
    return uuid.uuid4()


@case(DETERMINISTIC, "`uuid.uuid1`")
def uuid1(node: Any) -> object:
    return uuid.uuid1()


@case(DETERMINISTIC, "numpy's module functions")
def numpy_legacy(node: Any) -> object:
    return np.random.rand(), np.random.permutation(5).tolist()


@case(DETERMINISTIC, "`np.random.RandomState()` without a seed")
def numpy_unseeded_state(node: Any) -> object:
    return np.random.RandomState().rand()


@case(DETERMINISTIC, "`np.random.default_rng()` without a seed")
def numpy_default_rng(node: Any) -> object:
    return np.random.default_rng().random()


@case(DETERMINISTIC, "names of temporary files")
def temporary_names(node: Any) -> object:
    with tempfile.TemporaryDirectory() as folder:
        return os.path.basename(folder)


@case(DETECTED, "`/dev/urandom`")
def dev_urandom(node: Any) -> object:
    with open("/dev/urandom", "rb") as file:
        return file.read(8).hex()


@case(DETECTED, "SQLite's `random()`")
def sqlite_random(node: Any) -> object:
    with closing(sqlite3.connect(":memory:")) as connection:
        return connection.execute("SELECT random()").fetchall()


@case(DETERMINISTIC, "`random.seed()` without a seed")
def random_seed_of_nothing(node: Any) -> object:
    random.seed()
    return random.random(), random.Random(None).random()


@case(DETERMINISTIC, "`np.random.seed()` without a seed")
def numpy_seed_of_nothing(node: Any) -> object:
    np.random.seed()
    return np.random.rand()


@case(DETERMINISTIC, "`np.random.SeedSequence()`, `PCG64()` and other bit generators")
def numpy_bit_generators(node: Any) -> object:
    return np.random.SeedSequence().entropy, np.random.PCG64().random_raw()


@case(DETERMINISTIC, "`tempfile.mktemp`")
def made_up_name(node: Any) -> object:
    return os.path.basename(tempfile.mktemp())


@case(DETERMINISTIC, "memory that `np.empty` leaves as it was")
def uninitialized(node: Any) -> object:
    for _ in range(3):  # what is free again is given out again
        np.frombuffer(bytearray(os.urandom(64) * 125), dtype="uint8").copy()
        random_before = np.random.default_rng(time.time_ns()).random(1000)
        del random_before
    return np.empty(1000).tolist()


@case(DETERMINISTIC, "a generator that is seeded with the process id")
def seeded_by_process(node: Any) -> object:
    return random.Random(os.getpid()).random()


@case(DETECTED, "the C library's process id through `ctypes`")
def ctypes_process(node: Any) -> object:
    return ctypes.CDLL(None).getpid()


# -- order and addresses --------------------------------------------------------------------------


@case(DETERMINISTIC, "the order of a set of texts")
def set_of_texts(node: Any) -> object:
    return " ".join({"north", "east", "south", "west", "up", "down"})


@case(DETERMINISTIC, "`hash` of a text")
def hash_of_text(node: Any) -> object:
    return hash("a text")


@case(DETECTED, "the order of a set of objects that all hold the same")
def set_of_objects(node: Any) -> object:
    things = [Thing() for _ in range(200)]
    numbers = {id(thing): number for number, thing in enumerate(things)}
    return [numbers[id(thing)] for thing in set(things)]


@case(DETERMINISTIC, "the order of a set of objects")
def set_of_unlike_objects(node: Any) -> object:
    things = [Thing() for _ in range(200)]
    for number, thing in enumerate(things):
        thing.place = (number, [number / 2])  # type: ignore[attr-defined]
    return [thing.place for thing in set(things)]  # type: ignore[attr-defined]


@case(DETERMINISTIC, "the order of a set of methods")
def set_of_methods(node: Any) -> object:
    methods = {Caller(number).call for number in range(200)}
    return [method() for method in methods]


@case(DETERMINISTIC, "the order of a `WeakSet`")
def weak_set(node: Any) -> object:
    things = [Thing() for _ in range(200)]
    for number, thing in enumerate(things):
        thing.number = number  # type: ignore[attr-defined]
    return [thing.number for thing in weakref.WeakSet(things)]  # type: ignore[attr-defined]


@case(DETECTED, "`hash` of an object (and of `None` before Python 3.12)")
def hash_of_object(node: Any) -> object:
    return hash(Thing()), hash(None)


@case(DETECTED, "`id`")
def id_of_object(node: Any) -> object:
    return id(node)


@case(DETECTED, "sorting by `id`")
def sorted_by_id(node: Any) -> object:
    things = [Thing() for _ in range(200)]
    in_order = sorted(things, key=id)
    return [next(n for n, t in enumerate(things) if t is thing) for thing in in_order]


@case(DETERMINISTIC, "an address in a log record (the default `repr`)")
def default_repr(node: Any) -> object:
    return repr(Thing())


@case(DETERMINISTIC, "objects sorted by their `repr`")
def sorted_by_repr(node: Any) -> object:
    things = [Thing() for _ in range(200)]
    in_order = sorted(things, key=repr)
    return [next(n for n, t in enumerate(things) if t is thing) for thing in in_order]


@case(DETERMINISTIC, "the texts of functions, methods and generators")
def texts_of_functions(node: Any) -> object:
    return repr([lambda: node, node.create_timer, (n for n in (1, 2))])


@case(DETECTED, "an address of an object with `__slots__` in a log record")
def repr_without_weak_reference(node: Any) -> object:
    class Slotted:
        __slots__ = ()

    return repr(Slotted())


@case(DETECTED, "`ctypes.addressof`")
def address_of(node: Any) -> object:
    return ctypes.addressof(ctypes.c_int(0))


@case(DETERMINISTIC, "a pickled set of texts")
def pickled_set(node: Any) -> object:
    return pickle.dumps({"north", "east", "south", "west", "up", "down"})


@case(DETERMINISTIC, "`hash` of paths and dates")
def hash_of_values(node: Any) -> object:
    return hash(pathlib.PurePath("/a")), hash(date(2020, 1, 1))


@case(DETERMINISTIC, "a set of enumeration members")
def set_of_enums(node: Any) -> object:
    return [member.name for member in set(Way)]


@case(DETECTED, "a heap whose ties are decided by `id`")
def heap_by_id(node: Any) -> object:
    heap: list[tuple[int, int, int]] = []
    for number, thing in enumerate([Thing() for _ in range(200)]):
        heapq.heappush(heap, (0, id(thing), number))
    return [heapq.heappop(heap)[2] for _ in range(200)]


@case(DETERMINISTIC, "an address in a traceback's text")
def traceback_with_address(node: Any) -> object:
    try:
        raise ValueError(Thing())
    except ValueError:
        return traceback.format_exc()


@case(DETERMINISTIC, "`json.dumps` with `default=repr`")
def json_of_objects(node: Any) -> object:
    return json.dumps({"thing": Thing()}, default=repr)


@case(DETECTED, "how many objects there are (`gc.get_objects`)")
def objects_there_are(node: Any) -> object:
    return len(gc.get_objects()), os.getpid()


# -- finalizers, threads, event loops -------------------------------------------------------------


@case(DETERMINISTIC, "`__del__` of a cycle")
def finalizer(node: Any) -> object:
    words: list[object] = []
    Dying(words)
    gc.collect()
    return words


@case(DETERMINISTIC, "a weak reference's callback")
def weakref_callback(node: Any) -> object:
    words: list[object] = []
    thing = Thing()
    reference = weakref.ref(thing, lambda ref: words.append(time.monotonic_ns()))
    del thing
    return words, reference()


@case(DETERMINISTIC, "threads")
def threads(node: Any) -> object:
    words: list[object] = []
    started = [
        threading.Thread(target=lambda n=n: words.append((n, time.time_ns()))) for n in range(4)
    ]
    for thread in started:
        thread.start()
    for thread in started:
        thread.join()
    return words


@case(DETERMINISTIC, "a thread pool")
def thread_pool(node: Any) -> object:
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        return [f.result() for f in [pool.submit(random.random) for _ in range(4)]]


@case(DETERMINISTIC, "threads with a queue and sleeps")
def threads_with_queue(node: Any) -> object:
    words: queue.Queue[object] = queue.Queue()

    def work(number: int) -> None:
        time.sleep(random.random() / 1000)
        words.put((number, time.monotonic_ns()))

    for number in range(3):
        threading.Thread(target=work, args=(number,)).start()
    return [words.get(timeout=1) for _ in range(3)]


@case(DETERMINISTIC, "asyncio, with sleeps of random length")
def asyncio_sleep(node: Any) -> object:
    async def sleep(seconds: float) -> float:
        await asyncio.sleep(seconds)
        return asyncio.get_running_loop().time()

    async def both() -> object:
        return await asyncio.gather(sleep(0.003), sleep(random.random() / 100))

    return asyncio.run(both())


# -- outside --------------------------------------------------------------------------------------


@case(DETERMINISTIC, "the locale")
def the_locale(node: Any) -> object:
    try:
        return locale.setlocale(locale.LC_ALL, ""), locale.format_string("%.2f", 0.5)
    except locale.Error:
        return f"not installed: {os.environ.get('LC_ALL')}"


@case(DETERMINISTIC, "the order of `os.listdir` and `os.scandir`")
def list_directory(node: Any) -> object:
    return os.listdir(FOLDER), [entry.name for entry in os.scandir(FOLDER)]


@case(DETERMINISTIC, "the order of `glob` and `pathlib`")
def glob_and_pathlib(node: Any) -> object:
    names = [os.path.basename(path) for path in glob.glob(f"{FOLDER}/*")]
    return names, [path.name for path in pathlib.Path(FOLDER).iterdir()]


@case(DETERMINISTIC, "a multi-threaded BLAS")
def threaded_blas(node: Any) -> object:
    values = np.random.RandomState(1).rand(700, 700)
    return float(np.linalg.slogdet(values @ values.T + values)[1]), (values @ values).sum()


@case(DETECTED, "environment variables")
def environment(node: Any) -> object:
    return os.environ.get("HOME"), os.getenv("PADDING")


@case(DETECTED, "the working directory")
def working_directory(node: Any) -> object:
    return os.getcwd()


@case(DETERMINISTIC, "the process id")
def process_id(node: Any) -> object:
    return os.getpid()


@case(DETECTED, "the thread's number in the system")
def native_thread(node: Any) -> object:
    return threading.get_native_id()


@case(DETECTED, "`multiprocessing.current_process`")
def present_process(node: Any) -> object:
    return multiprocessing.current_process().pid


@case(DETECTED, "a descriptor that is read (`os.open`, `os.read`)")
def descriptor_read(node: Any) -> object:
    descriptor = os.open("/proc/self/stat", os.O_RDONLY)
    try:
        return os.read(descriptor, 999)
    finally:
        os.close(descriptor)


@case(DETECTED, "a file that is read")
def file_read(node: Any) -> object:
    return pathlib.Path("/proc/self/stat").read_text()


@case(DETECTED, "a file that is written, and its time")
def file_written(node: Any) -> object:
    path = pathlib.Path(tempfile.gettempdir()) / f"nasty{os.getpid()}"
    path.write_text("x")
    try:
        return path.stat().st_mtime_ns
    finally:
        path.unlink()


@case(DETECTED, "another process")
def another_process(node: Any) -> object:
    code = "import time; print(time.time_ns())"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout


@case(DETECTED, "sockets")
def sockets(node: Any) -> object:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()


@case(DETECTED, "signals from timers")
def signal_timer(node: Any) -> object:
    """How far a loop gets until the signal comes."""
    came: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: came.append(number))
    signal.setitimer(signal.ITIMER_REAL, 0.005)
    rounds = 0
    while not came:
        rounds += 1
    signal.signal(signal.SIGALRM, before)
    return rounds


FOLDER = "/nonexistent"


class Nasty(Node):  # type: ignore[misc]
    """Runs one case."""

    def __init__(self, case: str, folder: str) -> None:
        super().__init__(case)
        global FOLDER
        FOLDER = folder
        self.case = CASES[case][2]
        self.create_timer(0.5, self.tick)

    def tick(self) -> None:
        self.get_logger().info(str(self.case(self)))
