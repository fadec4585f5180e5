"""Who runs first, whoever starts a thread or the thread? Told on standard output, as JSON.

Run by Python and by rsltrace. Natively a thread goes on until it blocks: the switch interval is
long, so that a busy machine changes nothing. Where the kernel decides, the order of most rounds
counts: such a scenario is a race, and is run as often as the argument says.
"""

from __future__ import annotations

import _thread
import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

sys.setswitchinterval(1000.0)
ROUNDS = int(sys.argv[1])
ORDERS: dict[str, list[str]] = {}
RACES: dict[str, list[list[str]]] = {}
Scenario = Callable[[Callable[[str], None]], None]


def scenario(function: Scenario) -> None:
    order = ORDERS[function.__name__] = []
    function(order.append)
    time.sleep(0.02)  # whoever has something left to say says it


def race(function: Scenario) -> None:
    rounds: list[list[str]] = RACES.setdefault(function.__name__, [])
    for _ in range(ROUNDS):
        order: list[str] = []
        function(order.append)
        rounds.append(order)


def started(function: Callable[..., object], *arguments: object) -> threading.Thread:
    thread = threading.Thread(target=function, args=arguments)
    thread.start()
    return thread


@scenario
def start(say: Callable[[str], None]) -> None:
    thread = threading.Thread(target=lambda: say("child"))
    thread.start()
    say("parent")
    thread.join()


@scenario
def start_and_block(say: Callable[[str], None]) -> None:
    go = threading.Event()

    def child() -> None:
        say("child begins")
        go.wait()
        say("child goes on")

    thread = threading.Thread(target=child)
    thread.start()
    say("parent")
    go.set()
    say("parent has set it")
    thread.join()


@scenario
def poll_a_flag(say: Callable[[str], None]) -> None:
    ready: list[bool] = []
    threading.Thread(target=lambda: ready.append(True), daemon=True).start()
    say("ready" if ready else "not yet")


@scenario
def start_in_a_thread(say: Callable[[str], None]) -> None:
    def outer() -> None:
        thread = threading.Thread(target=lambda: say("inner"))
        thread.start()
        say("outer")
        thread.join()

    thread = threading.Thread(target=outer)
    thread.start()
    thread.join()


@scenario
def start_new_thread(say: Callable[[str], None]) -> None:
    _thread.start_new_thread(lambda: say("child"), ())
    say("parent")


@scenario
def timer(say: Callable[[str], None]) -> None:
    one = threading.Timer(0.01, lambda: say("child"))
    one.start()
    say("parent")
    one.join()


@scenario
def first_submit(say: Callable[[str], None]) -> None:
    with ThreadPoolExecutor(1) as pool:
        pool.submit(say, "child")
        say("parent")


@scenario
def later_submit(say: Callable[[str], None]) -> None:
    with ThreadPoolExecutor(1) as pool:
        pool.submit(time.sleep, 0).result()
        time.sleep(0.02)  # the worker waits for work
        pool.submit(say, "child")
        say("parent")


@scenario
def submit_to_a_second_worker(say: Callable[[str], None]) -> None:
    with ThreadPoolExecutor(2) as pool:
        pool.submit(time.sleep, 0.05)
        pool.submit(say, "child")
        say("parent")


@scenario
def event_set(say: Callable[[str], None]) -> None:
    event = threading.Event()
    thread = threading.Thread(target=lambda: (event.wait(), say("child")))
    thread.start()
    event.set()
    say("parent")
    thread.join()


@scenario
def queue_put(say: Callable[[str], None]) -> None:
    items: queue.Queue[str] = queue.Queue()
    thread = threading.Thread(target=lambda: say(items.get()))
    thread.start()
    items.put("child")
    say("parent")
    thread.join()


@scenario
def simple_queue_put(say: Callable[[str], None]) -> None:
    items: queue.SimpleQueue[str] = queue.SimpleQueue()
    thread = threading.Thread(target=lambda: say(items.get()))
    thread.start()
    items.put("child")
    say("parent")
    thread.join()


@scenario
def notify(say: Callable[[str], None]) -> None:
    condition = threading.Condition()

    def child() -> None:
        with condition:
            condition.wait()
        say("child")

    thread = threading.Thread(target=child)
    thread.start()
    with condition:
        condition.notify()
        say("parent has the lock")
    say("parent")
    thread.join()


@scenario
def semaphore(say: Callable[[str], None]) -> None:
    free = threading.Semaphore(0)
    thread = threading.Thread(target=lambda: (free.acquire(), say("child")))
    thread.start()
    free.release()
    say("parent")
    thread.join()


@scenario
def lock_that_is_held(say: Callable[[str], None]) -> None:
    lock = threading.Lock()

    def child() -> None:
        say("child wants it")
        with lock:
            say("child has it")

    with lock:
        thread = threading.Thread(target=child)
        thread.start()
        say("parent")
    say("parent gave it up")
    thread.join()


@scenario
def exception(say: Callable[[str], None]) -> None:
    threading.excepthook = lambda what: say(f"hook: {what.exc_value}")

    def child() -> None:
        raise ValueError("child")

    threading.Thread(target=child).start()
    say("parent")
    threading.excepthook = threading.__excepthook__


@scenario
def pool_in_a_pool(say: Callable[[str], None]) -> None:
    def outer() -> None:
        with ThreadPoolExecutor(2) as inner:
            list(inner.map(say, ("a", "b", "c")))
            say("outer")

    with ThreadPoolExecutor(1) as pool:
        pool.submit(outer)
        say("parent")


@scenario
def submit_in_a_pool(say: Callable[[str], None]) -> None:
    def outer() -> None:
        with ThreadPoolExecutor(1) as inner:
            inner.submit(say, "inner")
            say("outer")

    with ThreadPoolExecutor(1) as pool:
        pool.submit(outer)
        say("parent")


@scenario
def event_set_by_the_child(say: Callable[[str], None]) -> None:
    event = threading.Event()
    thread = started(lambda: (event.set(), say("child")))
    event.wait()
    say("parent")
    thread.join()


@scenario
def queue_that_is_full(say: Callable[[str], None]) -> None:
    items: queue.Queue[int] = queue.Queue(1)
    thread = started(lambda: [say(f"got {items.get()}") for _ in range(3)])
    for item in range(3):
        items.put(item)
        say(f"put {item}")
    thread.join()


@scenario
def there_and_back(say: Callable[[str], None]) -> None:
    there: queue.Queue[int] = queue.Queue()
    back: queue.Queue[int] = queue.Queue()
    thread = started(lambda: [(say(f"child {there.get()}"), back.put(0)) for _ in range(3)])
    for item in range(3):
        there.put(item)
        say(f"parent {item}")
        back.get()
    thread.join()


@scenario
def lock_that_is_waited_for_in_vain(say: Callable[[str], None]) -> None:
    lock = threading.Lock()
    with lock:
        threads = [started(lambda: say(f"child {lock.acquire(timeout=0.01)}"))]
        threads.append(started(lambda: (lock.acquire(), say("other child"), lock.release())))
        time.sleep(0.2)
        say("parent")
    for thread in threads:
        thread.join()


@race
def lock_taken_again(say: Callable[[str], None]) -> None:
    for lock in (threading.Lock(), threading.RLock()):

        def child(lock: threading.Lock = lock) -> None:  # type: ignore[assignment]
            with lock:
                say("child")

        with lock:
            thread = started(child)
            say("parent")
        for _ in range(2):
            with lock:
                say("parent again")
        thread.join()


@race
def start_after_waking_a_sleeper(say: Callable[[str], None]) -> None:
    event = threading.Event()
    sleeper = started(lambda: (event.wait(), say("sleeper")))
    time.sleep(0.005)
    event.set()
    child = started(say, "child")
    say("parent")
    child.join()
    sleeper.join()


@race
def start_in_a_thread_just_started(say: Callable[[str], None]) -> None:
    def outer() -> None:
        inner = started(say, "inner")
        say("outer")
        inner.join()

    thread = started(outer)
    say("parent")
    thread.join()


@race
def lock_held_while_sleeping(say: Callable[[str], None]) -> None:
    lock = threading.Lock()

    def child() -> None:
        with lock:
            say("child")

    def holder() -> None:
        for number in range(3):
            with lock:
                say(f"holder {number}")
                time.sleep(0.002)

    threads = [started(holder), started(child)]
    for thread in threads:
        thread.join()


print(json.dumps([ORDERS, RACES]))
