"""Threads that user code starts: cooperative, in simulated time, the same on every run."""

from __future__ import annotations

import _thread
import asyncio
import queue
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from rsltrace.errors import DeadlockError, NodeError
from tests.adapters.test_mains import Counter, listener, main_spec, seconds

pytestmark = pytest.mark.ros

REAL = {"start": _thread.start_new_thread}  # in a dictionary: a name of this module is exchanged


class Answers(Node):
    def __init__(self, delay: float = 0.0) -> None:
        super().__init__("answers")
        self.delay = delay
        self.create_service(Trigger, "ask", self.answer)

    def answer(self, request: Any, response: Any) -> Any:
        time.sleep(self.delay)
        response.message = f"at {seconds(self)}"
        return response


@pytest.mark.long
def test_the_thread_that_spins_beside_main(simulate: Any) -> None:
    """Half of all rclpy programs."""
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = listener(log)
        client = node.create_client(Trigger, "ask")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        assert thread.is_alive()
        client.wait_for_service()
        log.append((client.call(Trigger.Request()).message, seconds(node)))
        rate = node.create_rate(2)
        try:
            while rclpy.ok():
                rate.sleep()
                log.append(seconds(node))
        except KeyboardInterrupt:
            log.append("interrupted")
        finally:
            executor.shutdown()
            thread.join()
            log.append(("alive", thread.is_alive()))
            node.destroy_node()
            rclpy.try_shutdown()

    recorded = simulate(Counter, lambda: Answers(0.3), main_spec(program), duration=1.5)
    assert log == [
        ("at 0.3", 0.3), (1, 0.5), 0.8, (2, 1.0), 1.3, (3, 1.5), "interrupted", ("alive", False),
    ]  # fmt: skip
    with recorded.trace() as trace:
        (thread,) = [e for e in trace.entities.values() if e.kind.label == "thread"]
    assert thread.name == "Thread-1 (spin)"


def test_every_primitive_waits_in_simulated_time(simulate: Any) -> None:
    log: list[Any] = []

    class Both(Node):
        def __init__(self) -> None:
            super().__init__("both")
            group = ReentrantCallbackGroup()
            self.event, self.queue = threading.Event(), queue.Queue(maxsize=1)
            self.condition, self.numbers = threading.Condition(), []
            self.semaphore = threading.Semaphore(0)
            self.simple: Any = queue.SimpleQueue()
            self.barrier = threading.Barrier(2)
            self.future: Future[int] = Future()
            self.waiting = self.create_timer(1.0, self.wait, callback_group=group)
            self.giving = self.create_timer(1.5, self.give, callback_group=group)

        def say(self, what: str, value: Any) -> None:
            log.append((what, value, seconds(self)))

        def wait(self) -> None:
            self.waiting.cancel()
            self.say("not set", self.event.wait(0.25))
            self.say("set", self.event.wait())
            self.say("queue", self.queue.get())
            self.say("queue", self.queue.get(timeout=5))
            with self.condition:
                self.condition.wait_for(lambda: self.numbers)
            self.say("condition", self.numbers)
            self.semaphore.acquire()
            self.say("semaphore", None)
            self.say("simple", self.simple.get())
            self.say("future", self.future.result())
            self.barrier.wait()
            self.say("barrier", None)
            try:
                self.queue.get(timeout=0.5)
            except queue.Empty:
                self.say("empty", None)

        def give(self) -> None:
            self.giving.cancel()
            self.event.set()
            self.queue.put(1)
            self.queue.put(2)
            self.say("put", self.queue.qsize())
            time.sleep(0.5)
            with self.condition:
                self.numbers.append(7)
                self.condition.notify()
            self.semaphore.release()
            time.sleep(0.5)
            self.simple.put("x")
            self.future.set_result(9)
            time.sleep(0.5)
            self.barrier.wait()

    simulate(Both, duration=10)
    assert log == [
        ("not set", False, 1.25), ("set", True, 1.5), ("queue", 1, 1.5), ("put", 1, 1.5),
        ("queue", 2, 1.5), ("condition", [7], 2.0), ("semaphore", None, 2.0), ("simple", "x", 2.5),
        ("future", 9, 2.5), ("barrier", None, 3.0), ("empty", None, 3.5),
    ]  # fmt: skip


def test_locks_exclude_threads_that_are_suspended_and_idents_tell_them_apart(simulate: Any) -> None:
    log: list[Any] = []

    class Workers(Node):
        def __init__(self) -> None:
            super().__init__("workers")
            self.lock, self.own = threading.RLock(), threading.local()
            self.own.name = "main"
            self.create_timer(1.0, self.begin)

        def begin(self) -> None:
            self.threads = [threading.Thread(target=self.work, name=f"w{n}") for n in range(3)]
            for thread in self.threads:
                thread.start()
            assert threading.active_count() >= 4
            for thread in self.threads:
                thread.join()
            log.append((self.own.name, threading.current_thread().name, seconds(self)))
            raise SystemExit

        def work(self) -> None:
            assert not hasattr(self.own, "name")
            self.own.name = threading.current_thread().name
            with self.lock, self.lock:
                begun = seconds(self)
                time.sleep(0.5)
                log.append((self.own.name, begun, seconds(self)))
            assert threading.get_ident() == threading.current_thread().ident

    simulate(Workers)
    assert log == [
        ("w0", 1.0, 1.5),
        ("w1", 1.5, 2.0),
        ("w2", 2.0, 2.5),
        ("main", "MainThread", 2.5),
    ]


def test_who_gives_up_waiting_is_forgotten(simulate: Any) -> None:
    """However often somebody looks whether a thread has ended, or whether a lock is free."""
    left: list[int] = []

    class Patient(Node):
        def __init__(self) -> None:
            super().__init__("patient")
            self.lock = threading.Lock()
            self.create_timer(1.0, self.begin)

        def begin(self) -> None:
            thread = threading.Thread(target=self.work)
            thread.start()
            for _ in range(100):
                thread.join(0.01)
                assert not self.lock.acquire(timeout=0.01)
            assert thread.is_alive()
            left.extend((len(thread._rsltrace._joining), len(self.lock._waits)))
            thread.join()
            raise SystemExit

        def work(self) -> None:
            with self.lock:
                time.sleep(5.0)

    simulate(Patient)
    assert left == [0, 0]


def test_thread_pools_timers_and_raw_threads(simulate: Any) -> None:
    log: list[Any] = []

    class Pool(Node):
        def __init__(self) -> None:
            super().__init__("pool")
            self.create_timer(1.0, self.tick)

        def work(self, n: int) -> int:
            time.sleep(n / 10)
            return n

        def tick(self) -> None:
            threading.Timer(0.35, lambda: log.append(("timer", seconds(self)))).start()
            done = threading.Event()
            _thread.start_new_thread(lambda: (time.sleep(0.05), done.set()), ())
            with ThreadPoolExecutor(2) as pool:
                futures = [pool.submit(self.work, n) for n in (3, 1, 4)]
                for future in as_completed(futures):
                    log.append((future.result(), round(seconds(self), 6)))
                assert not wait(futures).not_done
                assert list(pool.map(self.work, (2, 1))) == [2, 1]
            assert done.is_set()
            raise SystemExit

    recorded = simulate(Pool)
    assert log == [(1, 1.1), (3, 1.3), ("timer", 1.35), (4, 1.5)]
    with recorded.trace() as trace:
        names = [e.name for e in trace.entities.values() if e.kind.label == "thread"]
    assert names[0] == "Thread-1"
    assert names[2:] == [
        "ThreadPoolExecutor-0_0",
        "ThreadPoolExecutor-0_1",
    ]


def test_a_multi_threaded_executor_overlaps_callbacks_where_they_block(simulate: Any) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("busy")
        group = ReentrantCallbackGroup()

        def slow() -> None:
            log.append(("begin", seconds(node)))
            time.sleep(1.5)
            log.append(("end", seconds(node)))

        node.create_timer(1.0, slow, callback_group=group)
        executor = MultiThreadedExecutor(num_threads=2)
        executor.add_node(node)
        try:
            executor.spin()
        except KeyboardInterrupt:
            log.append("interrupted")

    simulate(main_spec(program), duration=4.2)
    assert log == [
        ("begin", 1.0), ("begin", 2.0), ("end", 2.5), ("begin", 3.0), ("end", 3.5),
        ("begin", 4.0), "interrupted", ("end", 4.0), ("end", 4.0),  # Python joins its workers
    ]  # fmt: skip


def test_a_single_threaded_executor_is_busy_while_a_callback_blocks(simulate: Any) -> None:
    log: list[float] = []

    def program() -> None:
        rclpy.init()
        node = Node("busy")
        group = ReentrantCallbackGroup()
        node.create_timer(1.0, lambda: time.sleep(0.7), callback_group=group)
        node.create_timer(1.25, lambda: log.append(seconds(node)), callback_group=group)
        rclpy.spin(node)

    simulate(main_spec(program), duration=4)
    assert log == [1.7, 2.7, 3.75]


def test_a_deadlock_of_two_locks_names_both_sides(simulate: Any) -> None:
    class Knot(Node):
        def __init__(self) -> None:
            super().__init__("knot")
            self.a, self.b = threading.Lock(), threading.Lock()
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            threads = [
                threading.Thread(target=self.take, args=pair, name=name)
                for name, pair in {"left": (self.a, self.b), "right": (self.b, self.a)}.items()
            ]
            for thread in threads:
                thread.start()
            threads[0].join()

        def take(self, first: Any, second: Any) -> None:
            with first:
                time.sleep(0.1)
                with second:
                    pass

    with pytest.raises(DeadlockError) as caught:
        simulate(Knot)
    text = str(caught.value)
    assert "/knot: thread left waits for a lock that is held by /knot: thread right" in text
    assert "/knot: thread right waits for a lock that is held by /knot: thread left" in text
    assert "Knot.tick waits for thread left to end" in text
    assert text.count("in take") == 2


def test_a_lock_taken_twice_is_a_deadlock_that_names_who_holds_it(simulate: Any) -> None:
    def program() -> None:
        rclpy.init()
        lock = threading.Lock()
        with lock, lock:
            pass

    with pytest.raises(DeadlockError, match="program waits for a lock that it holds itself"):
        simulate(main_spec(program))


def test_what_a_thread_raises_ends_the_run(simulate: Any) -> None:
    class Fails(Node):
        def __init__(self) -> None:
            super().__init__("fails")
            self.create_timer(1.0, lambda: threading.Timer(0.5, lambda: 1 / 0).start())

    with pytest.raises(NodeError, match=r"/fails: thread .* 1\.5\d* s raised ZeroDivisionError"):
        simulate(Fails, duration=3)


@pytest.mark.long
def test_shutdown_ends_a_thread_that_spins(simulate: Any) -> None:
    log: list[str] = []

    def program() -> None:
        rclpy.init()
        node = Counter()
        executor = SingleThreadedExecutor()
        executor.add_node(node)

        def spin() -> None:
            try:
                executor.spin()
                log.append("spin returned")
            except ExternalShutdownException:
                log.append("shut down")

        thread = threading.Thread(target=spin)
        thread.start()
        time.sleep(1.2)
        rclpy.shutdown()
        thread.join()
        log.append("joined")

    recorded = simulate(main_spec(program), duration=9)
    assert log == ["shut down", "joined"]
    assert recorded.result.sim_seconds == "1.200000000"


def test_a_main_waits_for_its_threads_and_takes_its_daemons_with_it(simulate: Any) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("short")

        def work() -> None:
            time.sleep(1.0)
            log.append(("work", seconds(node)))

        def for_ever() -> None:
            try:
                while True:
                    time.sleep(0.4)
                    log.append(("daemon", seconds(node)))
            finally:
                log.append("daemon unwound")

        threading.Thread(target=work).start()
        threading.Thread(target=for_ever, daemon=True).start()
        log.append("main returns")

    simulate(main_spec(program), Counter, duration=3)
    assert log == [
        "main returns", ("daemon", 0.4), ("daemon", 0.8), ("work", 1.0), "daemon unwound",
    ]  # fmt: skip


def test_nodes_see_no_threads_of_who_has_started_the_run(simulate: Any) -> None:
    over = threading.Event()
    foreign = threading.Thread(target=over.wait, daemon=True)
    seen: list[Any] = []

    class Looks(Node):
        def __init__(self) -> None:
            super().__init__("looks")
            self.create_timer(1.0, self.look)

        def look(self) -> None:
            own = threading.Thread(target=time.sleep, args=(1,), name="own")
            own.start()
            seen.append([thread.name for thread in threading.enumerate()])
            seen.append(threading.active_count())
            own.join()
            raise SystemExit

    foreign.start()
    try:
        simulate(Looks)
        assert foreign in threading.enumerate()
    finally:
        over.set()
        foreign.join()
    assert seen == [["MainThread", "own"], 2]


@pytest.mark.long
def test_nothing_is_left_after_a_run(simulate: Any) -> None:
    before = (
        threading.Lock, threading.RLock(), threading.local, threading.Thread.start, time.sleep,
        threading.get_ident, queue.SimpleQueue, threading.enumerate(), _thread.start_new_thread,
    )  # fmt: skip
    kept: list[Any] = []

    class Starts(Node):
        def __init__(self) -> None:
            super().__init__("starts")
            kept.append(ThreadPoolExecutor(1))
            kept.append(kept[0].submit(time.sleep, 100))
            self.create_timer(1.0, lambda: None)

    simulate(Starts, duration=2)
    after = (
        threading.Lock, threading.RLock(), threading.local, threading.Thread.start, time.sleep,
        threading.get_ident, queue.SimpleQueue, threading.enumerate(), _thread.start_new_thread,
    )  # fmt: skip
    assert type(before[1]) is type(after[1])
    assert before[2:] == after[2:]
    assert before[0] is after[0]
    began = time.monotonic()
    time.sleep(0.01)
    assert time.monotonic() - began >= 0.01
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(threading.get_ident).result() != threading.get_ident()
    kept[0].shutdown(wait=True)


@pytest.mark.long
def test_a_real_thread_is_told_what_it_cannot_do(simulate: Any) -> None:
    """As a library in C starts them."""
    heard: list[BaseException] = []
    slept: list[float] = []

    class Real(Node):
        def __init__(self) -> None:
            super().__init__("real")
            self.client = self.create_client(Trigger, "ask")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            done: list[int] = []

            def work() -> None:
                began = time.perf_counter_ns()
                time.sleep(0.02)
                slept.append(time.perf_counter_ns() - began)
                try:
                    self.client.call(Trigger.Request())
                except BaseException as error:
                    heard.append(error)
                done.append(1)

            REAL["start"](work, ())
            while not done:
                pass
            raise SystemExit

    simulate(Real, Answers)
    assert slept[0] >= 20_000_000
    assert "waits for the response to a service call" in str(heard[0])


@pytest.mark.long
def test_threads_give_the_same_digest_every_time(simulate: Any) -> None:
    def run() -> str:
        def program() -> None:
            rclpy.init()
            node = Node("many")
            publisher = node.create_publisher(UInt64, "numbers", 10)
            lock = threading.Lock()

            def work(n: int) -> None:
                for turn in range(5):
                    with lock:
                        time.sleep(0.01 * n)
                    publisher.publish(UInt64(data=n * 10 + turn))

            with ThreadPoolExecutor() as pool:
                list(pool.map(work, range(6)))

        return str(simulate(main_spec(program), Counter, duration=3).result.digest)

    assert len({run() for _ in range(4)}) == 1


@pytest.mark.long
def test_asyncio_loops_keep_simulated_time_and_wake_each_other(simulate: Any) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("mixed")
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_forever, daemon=True)
        thread.start()

        async def ticks(name: str, period: float) -> str:
            for _ in range(2):
                await asyncio.sleep(period)
                log.append((name, seconds(node)))
            return name

        node.create_timer(0.5, lambda: log.append(("ros", seconds(node))))

        async def main() -> None:
            assert asyncio.get_running_loop() is not loop
            other = asyncio.run_coroutine_threadsafe(ticks("thread", 0.4), loop)
            both = await asyncio.gather(ticks("main", 0.3), asyncio.wrap_future(other))
            log.append((both, seconds(node)))
            await asyncio.get_running_loop().run_in_executor(None, time.sleep, 0.1)
            for _ in range(3):
                rclpy.spin_once(node, timeout_sec=0)
                await asyncio.sleep(0.25)

        asyncio.run(main())
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
        log.append(seconds(node))

    simulate(main_spec(program), duration=5)
    assert [(what, round(at, 6)) for what, at in log[:-1]] == [
        ("main", 0.3), ("thread", 0.4), ("main", 0.6), ("thread", 0.8),
        (["main", "thread"], 0.8), ("ros", 0.9), ("ros", 1.15),
    ]  # fmt: skip
    assert round(log[-1], 6) == 1.65


@pytest.mark.long
def test_an_rclpy_future_awaited_in_asyncio_is_polled_and_time_passes(simulate: Any) -> None:
    """asyncio asks again at once whatever is not its own: its loop is never idle, as in reality."""
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("mixed")
        future: rclpy.Future[str] = rclpy.Future()
        node.create_timer(0.5, lambda: future.set_result("done"))

        async def spinning() -> None:
            while rclpy.ok():
                rclpy.spin_once(node, timeout_sec=0.01)
                await asyncio.sleep(0.001)

        async def yielding() -> None:
            for _ in range(90):
                await asyncio.sleep(0)
            log.append(("yielded", seconds(node)))

        async def main() -> None:
            await yielding()
            spin = asyncio.get_running_loop().create_task(spinning())
            log.append((await future, seconds(node)))
            spin.cancel()

        asyncio.run(main())

    simulate(main_spec(program), duration=2)
    (yielded, done) = log
    assert yielded == ("yielded", 0.0), "giving way a few times takes no time"
    assert done[0] == "done"
    assert 0.5 <= done[1] < 0.52


@pytest.mark.long
def test_asyncio_is_real_again_after_a_run(simulate: Any) -> None:
    before = asyncio.BaseEventLoop.time, asyncio.SelectorEventLoop.__init__
    simulate(Counter, duration=1)
    assert (asyncio.BaseEventLoop.time, asyncio.SelectorEventLoop.__init__) == before
    began = time.monotonic()
    asyncio.run(asyncio.sleep(0.01))
    assert time.monotonic() - began >= 0.009


@pytest.mark.long
def test_threads_that_have_ended_are_forgotten(simulate: Any) -> None:
    alive: list[int] = []

    class Short(Node):
        def __init__(self) -> None:
            super().__init__("short")
            self.create_timer(0.01, self.tick)

        def tick(self) -> None:
            threading.Timer(0.015, lambda: None).start()
            alive.append(len(self.handle.runtime.threads.alive))

    simulate(Short, duration=1)
    assert len(alive) == 100
    assert max(alive) <= 3


@pytest.mark.long
def test_a_timer_is_written_down_although_a_thread_spins_its_node_only_later(simulate: Any) -> None:
    def main() -> None:
        rclpy.init()
        node = Node("late")
        node.create_timer(0.2, lambda: None)
        thread = threading.Thread(target=rclpy.spin, args=(node,))
        thread.start()  # before it runs, main has blocked, and its event has ended
        thread.join()

    recorded = simulate(main_spec(main), duration=1)
    with recorded.trace() as trace:
        timers = {e.entity for e in recorded.events() if e.kind.label == "timer"}
        assert [trace.entities[number].kind.label for number in timers] == ["timer"]
        assert [trace.entities[trace.entities[n].node].name for n in timers] == ["/late"]


@pytest.mark.long
def test_a_pool_that_is_used_in_the_pool_of_an_executor(simulate: Any) -> None:
    """All pools of a process share a lock, which is taken while a worker is started."""
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("pools")
        pool = ThreadPoolExecutor(1)

        def work() -> float:
            time.sleep(0.7)
            return seconds(node)

        def tick() -> None:
            pool.submit(work).add_done_callback(lambda done: log.append(done.result()))

        node.create_timer(1.0, tick)
        executor = MultiThreadedExecutor()
        executor.add_node(node)
        executor.spin()

    simulate(main_spec(program), duration=3)
    assert log[:2] == [1.7, 2.7]
