"""A node that misbehaves as it is told: ``plan`` is a list of what to do where.

Each step is ``{"where": …, "what": …, "at": n}``. Where: ``before`` super().__init__(), in the
``constructor``, in the ``n``-th ``timer`` callback, in a ``message`` callback, in ``destroy``.

Files are hurt in the folder of this module alone, and only if that is a case's: the attack copies
it there. Wherever the process has gone meanwhile, nothing else is touched.
"""

import array
import atexit
import ctypes
import gc
import glob
import math
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time

import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64, String, UInt64


class Mischief(Node):
    """Ticks, listens, and does what its plan says."""

    def __init__(self, plan):
        self.plan = plan
        self.count = 0
        self.kept = []
        self.do("before")
        if not any(step["what"] == "no_super" for step in plan):
            super().__init__("mischief")
        self.out = self.create_publisher(UInt64, "mischief", 10)
        self.create_subscription(UInt64, "ticks", self.on_tick, 10)
        self.create_timer(0.02, self.tick)
        self.do("constructor")

    def tick(self):
        self.count += 1
        self.out.publish(UInt64(data=self.count))
        self.do("timer")

    def on_tick(self, message):
        if message.data == 5:
            self.do("message")

    def destroy_node(self):
        self.do("destroy")
        super().destroy_node()

    def do(self, where):
        for step in self.plan:
            if step["where"] == where and (where != "timer" or step["at"] == self.count):
                getattr(sys.modules[__name__], step["what"])(self)


def no_super(node):
    pass


def close_descriptors(node):
    os.closerange(3, 4096)


def close_and_take(node):
    """What is opened next gets the number that was the trace's."""
    os.closerange(3, 4096)
    node.mine = open(os.path.join(_folder(), "mine.txt"), "w")  # noqa: SIM115
    node.mine.write("mine")
    node.mine.flush()


def dup2_over_all(node):
    handle = os.open(os.path.join(_folder(), "mine.txt"), os.O_RDWR | os.O_CREAT | os.O_APPEND)
    for number in range(3, 200):
        if number != handle:
            os.dup2(handle, number)


def close_stdout(node):
    os.close(1)


def close_stderr(node):
    os.close(2)


def replace_stdout(node):
    sys.stdout = sys.stderr = None


class _Broken:
    def write(self, text):
        raise RuntimeError("no")

    def flush(self):
        raise RuntimeError("no")


def broken_stdout(node):
    sys.stdout = sys.stderr = _Broken()


def closed_stdout(node):
    sys.stdout.close()


def fork_and_go_on(node):
    os.fork()


def fork_and_exit(node):
    if os.fork() == 0:
        os._exit(0)


def fork_and_raise(node):
    if os.fork() == 0:
        raise RuntimeError("in the child")


def fork_and_sys_exit(node):
    if os.fork() == 0:
        sys.exit(0)


def process_of_multiprocessing(node):
    context = multiprocessing.get_context("fork")
    worker = context.Process(target=print)
    worker.start()
    worker.join()


def popen(node):
    subprocess.run(["true"], check=True)


def _folder():
    folder = os.path.dirname(os.path.abspath(__file__))
    assert "/rsltrace-attack-" in folder, folder
    return folder


def _traces():
    return glob.glob(os.path.join(_folder(), "*.mcap*"))


def delete_output(node):
    for path in _traces():
        os.unlink(path)


def rename_output(node):
    for path in _traces():
        os.rename(path, path + "-moved")


def truncate_output(node):
    for path in _traces():
        os.truncate(path, 100)


def replace_output(node):
    for path in _traces():
        os.unlink(path)
        with open(path, "w") as file:
            file.write("mine")


def append_to_output(node):
    for path in _traces():
        with open(path, "ab") as file:
            file.write(b"mine")


def overwrite_output(node):
    for path in _traces():
        with open(path, "r+b") as file:
            file.seek(20)
            file.write(b"mine" * 100)


def delete_folder(node):
    shutil.rmtree(_folder(), ignore_errors=True)


def chdir(node):
    os.chdir("/")


def umask(node):
    os.umask(0o777)


def no_descriptors(node):
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))


def small_files(node):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))


def exit_at_once(node):
    os._exit(7)


def exit_zero_at_once(node):
    os._exit(0)


def abort(node):
    os.abort()


def segfault(node):
    ctypes.string_at(0)


def kill_self(node):
    os.kill(os.getpid(), signal.SIGKILL)


def terminate_self(node):
    os.kill(os.getpid(), signal.SIGTERM)


def hang_up_self(node):
    os.kill(os.getpid(), signal.SIGHUP)


def interrupt_self(node):
    os.kill(os.getpid(), signal.SIGINT)


def raises(node):
    raise RuntimeError("mischief")


def raises_escapes(node):
    raise RuntimeError("\x1b]0;owned\x07\x1b[31m\rred\x9b1m")


class _Unprintable(Exception):
    def __str__(self):
        raise RuntimeError("no text")

    __repr__ = __str__


def raises_unprintable(node):
    raise _Unprintable()


def raises_group(node):
    error = RuntimeError("outer")
    error.__cause__ = error
    raise error


def sys_exit(node):
    sys.exit(5)


def sys_exit_text(node):
    sys.exit("\x1b[31mbye")


def keyboard_interrupt(node):
    raise KeyboardInterrupt


def generator_exit(node):
    raise GeneratorExit


def memory_error(node):
    raise MemoryError


def recursion(node):
    recursion(node)


def recursion_of_data(node):
    node.deep = []
    for _ in range(100_000):
        node.deep = [node.deep]


def set_timer(node):
    signal.setitimer(signal.ITIMER_REAL, 0.02)


def set_alarm(node):
    signal.alarm(1)


def profile_timer(node):
    signal.setitimer(signal.ITIMER_PROF, 0.05)


def handlers(node):
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *args: None)


def negative_period(node):
    node.create_timer(-1.0, node.tick)


def nan_period(node):
    node.create_timer(math.nan, node.tick)


def huge_period(node):
    node.create_timer(1e30, node.tick)


def zero_period(node):
    node.create_timer(0.0, lambda: None)


def wrong_field(node):
    node.out.publish(UInt64(data=-1))


def wrong_type(node):
    node.out.publish(String(data="x"))


def wrong_attribute(node):
    message = UInt64()
    message._data = "x"
    node.out.publish(message)


def surrogates(node):
    node.create_publisher(String, "text", 1).publish(String(data="\ud800\udc00"))


def not_a_message(node):
    node.out.publish(5)


def nan_message(node):
    publisher = node.create_publisher(Float64, "nan", 10)
    for value in (math.nan, math.inf, -0.0, 5e-324):
        publisher.publish(Float64(data=value))


def huge_message(node):
    node.create_publisher(String, "huge", 10).publish(String(data="x" * 20_000_000))


def many_messages(node):
    for count in range(5000):
        node.out.publish(UInt64(data=count))


def many_logs(node):
    for count in range(2000):
        node.get_logger().info(f"log {count}")


def log_escapes(node):
    node.get_logger().warn("\x1b]0;owned\x07 \x9b31m \r\x08 \u202e \ud800 \0 end")


def bad_names(node):
    node.create_publisher(UInt64, "bad name\x1b[31m", 1)


def many_entities(node):
    for count in range(200):
        node.create_publisher(UInt64, f"topic_{count}", 1)


def bad_parameter(node):
    node.declare_parameter("\x1b[31m", object())


def shut_down(node):
    rclpy.shutdown()


def destroy_self(node):
    node.destroy_node()


def destroy_publisher(node):
    node.destroy_publisher(node.out)


def another_node(node):
    node.kept.append(Node("mischief"))


def executor_inside(node):
    rclpy.spin_once(node, timeout_sec=0.1)


def sleeps(node):
    time.sleep(0.05)


def thread_that_raises(node):
    def work():
        raise RuntimeError("in a thread")

    threading.Thread(target=work).start()


def thread_that_waits(node):
    thread = threading.Thread(target=lambda: time.sleep(1000), daemon=True)
    thread.start()
    node.kept.append(thread)


def raises_at_exit(node):
    def last():
        raise RuntimeError("at exit")

    atexit.register(last)


def raises_when_collected(node):
    class Late:
        def __del__(self):
            raise RuntimeError("collected")

    node.kept.append(Late())


def no_collector(node):
    gc.disable()
    gc.set_threshold(1)


def breaks_open(node):
    import builtins

    builtins.open = None
    os.open = None


def breaks_os_write(node):
    def fails(*args, **options):
        raise OSError(5, "broken")

    os.write = os.pwrite = os.pwritev = os.fsync = os.replace = os.rename = fails


def breaks_modules(node):
    for name in ("json", "struct", "traceback", "zstandard"):
        sys.modules.pop(name, None)


def breaks_hash(node):
    class Key:
        def __hash__(self):
            raise RuntimeError("no hash")

    node.key = Key()
    sys.setrecursionlimit(60)


def excepthook(node):
    sys.excepthook = None


def clears_environment(node):
    os.environ.clear()


def settrace(node):
    sys.settrace(lambda *args: None)


def strange_repr(node):
    class Strange:
        def __repr__(self):
            raise RuntimeError("no repr")

        def __getattr__(self, name):
            raise RuntimeError("no attribute")

    node.create_timer(0.05, Strange)


def array_of_wrong_kind(node):
    node.out.publish(UInt64(data=array.array("d", [1.0])))
