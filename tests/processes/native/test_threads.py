"""Threads of a process run one at a time, in one order, and on simulated time."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from tests.processes.native.conftest import Corner, Programs, Ran

pytestmark = pytest.mark.long

_RUNS = 100


@contextmanager
def _load(count: int) -> Iterator[None]:
    hogs = [subprocess.Popen(["sh", "-c", "while :; do :; done"]) for _ in range(count)]
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def _surroundings() -> list[list[str]]:
    """Return ways to start a program: on one core or all, with addresses fixed or not."""
    cores = sorted(os.sched_getaffinity(0))
    ways: list[list[str]] = [[]]
    if shutil.which("taskset"):
        ways += [["taskset", "-c", str(core)] for core in cores[:2]]
    if (
        shutil.which("setarch")
        and subprocess.run(["setarch", "-R", "true"], check=False).returncode == 0
    ):
        ways += [["setarch", "-R", *way] for way in ways]
    return ways


def _natively(programs: Programs, *words: str) -> Ran:
    """Run a program natively: under load 6 of 2,800 runs waited for ever, since
    libstdc++'s ``counting_semaphore`` may lose a wake-up (GCC's bug 98033)."""
    for _ in range(4):
        with suppress(subprocess.TimeoutExpired):
            return programs.run(*words, native=True, timeout_s=30)
    return programs.run(*words, native=True)


@pytest.mark.parametrize("seed", range(1, 41))
def test_random_programs_do_the_same_everywhere_and_what_they_do_natively(
    programs: Programs, seed: int
) -> None:
    native = _natively(programs, "random_threads", str(seed))
    first = programs.run("random_threads", str(seed))
    assert first.status == 0, first.err
    assert first.out == native.out
    for way in _surroundings():
        assert programs.run("random_threads", str(seed), before=way) == first


def test_a_hundred_runs_under_load_are_one(programs: Programs) -> None:
    ways = _surroundings()
    with _load(6):
        runs = {
            programs.run("random_threads", "50", before=ways[number % len(ways)])
            for number in range(_RUNS)
        }
    assert len(runs) == 1
    assert "thread_local destroyed" in runs.pop().err


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("itself", r"thread 0 .* waits in pthread_mutex_lock at .*, which it holds itself"),
        (
            "cycle",
            r"thread 1 .* waits in pthread_mutex_lock at .*, which thread 0 .* holds.*"
            r"thread 0 .* waits in pthread_mutex_lock at .*, which thread 1 .* holds",
        ),
        (
            "everybody",
            r"thread 0 .* waits in pthread_join for thread 1 \(waiter\)\n"
            r" +std::thread::join\(\) .*thread 1 \(waiter\) waits in pthread_cond_wait at",
        ),
    ],
)
def test_a_deadlock_names_who_waits_for_what(corner: Corner, name: str, said: str) -> None:
    ran = corner(name)
    assert ran.status == 86  # of the loop in lone_loop.cpp: nobody is left who could go on
    assert re.search(r"report: deadlock.*: .*\n +" + said, ran.err, re.DOTALL), ran.err


@pytest.mark.parametrize(
    ("name", "out", "status"),
    [
        ("handler_posts", "5000 sent\n-1 1 995000000\n5000 posted\n", 0),
        ("thread_signals", "1000 handled\n1000 woken\n1000 sigwait\n", 0),
        (
            "cancel",
            "".join(f"{n}000 unwound\n{n}000 cancelled\n" for n in range(1, 6)),
            0,
        ),
        (
            "destructors",
            "0 thread\n0 thread_local\n1000 key\n1000 joined\n1000 atexit\n3000 detached\n"
            "6000 joined by a static destructor\n",
            0,
        ),
        ("main_leaves", "3000 after main\n3000 atexit\n", 0),
        ("exit", "1000 atexit\n", 3),
        ("_exit", "", 4),
        ("crash", "", -signal.SIGSEGV),
        ("children", "10 12 13 14 \n", 0),
        ("processors", "4 4 4 4 0\n", 0),
        ("clocks", f"{' '.join(['1700000000'] * 5)}\n3600\n1000000\n", 0),
        ("busy", "20000 yielded\n30000 looked\n35000 polled\n", 0),
        ("processor_time", "2 2 0\n", 0),
        ("inner_files", "7000 wrote\n7000 pipe\n14000 socket\n", 0),
    ],
)
def test_what_programs_do_with_threads_time_and_signals(
    corner: Corner, name: str, out: str, status: int
) -> None:
    ran = corner(name)
    assert (ran.out, ran.status) == (out, status), ran.err


def test_what_is_built_with_checks_of_lengths_is_simulated_too(corner: Corner) -> None:
    """As most programs of distributions are: libc has functions of other names for them."""
    ran = corner("fortified")
    *said, drawn = ran.out.splitlines()
    assert said == ["5000 polled", "6000 read", "7000 recv", "8000 recvfrom", "9000 ppolled"]
    assert "outside" not in ran.err
    assert drawn == corner("fortified").out.splitlines()[-1] != "0" * 16


def test_who_writes_more_than_there_is_room_for_waits_for_who_reads(corner: Corner) -> None:
    ran = corner("full")
    assert re.fullmatch(r"(?:\d+ (?:read|wrote all)\n){12}", ran.out), ran.err
    assert "outside" not in ran.err
    assert corner("full") == ran


def test_what_libraries_do_when_they_are_loaded_is_part_of_the_run(programs: Programs) -> None:
    """Their constructors come before those of what is preloaded."""
    ran = programs.run("early")
    assert re.fullmatch(r"0 (\d+) 0\n10000000 \1 3\n", ran.out), ran.err
    assert programs.run("early") == ran


@pytest.mark.skipif(shutil.which("setarch") is None, reason="needs setarch")
def test_where_memory_lies_does_not_depend_on_real_time(programs: Programs) -> None:
    fixed = ["setarch", "-R"]
    if subprocess.run([*fixed, "true"], check=False).returncode != 0:
        pytest.skip("the system does not let addresses be fixed")
    quick = programs.run("layout", "0", before=fixed)
    assert quick.out.count("\n") == 20
    assert programs.run("layout", "600", before=fixed) == quick  # as long as a look from outside


def test_chance_comes_from_the_seed_and_every_source_goes_on(corner: Corner) -> None:
    ran = corner("entropy")
    assert ran.out == corner("entropy").out != corner("entropy", native=True).out
    assert len(set(ran.out.split())) == 10
    assert re.search(r" \w{8}-\w{4}-4\w{3}-[89ab]\w{3}-\w{12} ", ran.out)


def test_timers_that_count_real_time_are_named_once(corner: Corner) -> None:
    ran = corner("real_timers")
    said = [line for line in ran.err.splitlines() if "counts real time" in line]
    assert (ran.out, len(said)) == ("made\n", 3), ran.err


@pytest.mark.parametrize("name", ["outside_pipe", "outside_unseen"])
def test_who_blocks_outside_is_named_and_the_others_go_on(programs: Programs, name: str) -> None:
    library = {"LD_PRELOAD": str(programs.folder / "libtry.so"), "RSLTRACE_LONE": "1"}
    with subprocess.Popen(
        [str(programs.folder / "corner_cases"), name],
        env=os.environ | library,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdin
        assert child.stdout
        assert child.stderr
        guard = threading.Timer(300, child.kill)
        guard.start()
        assert child.stdout.readline().endswith("others go on\n")  # while it still waits
        child.stdin.write("hello\n")
        child.stdin.flush()
        assert child.stdout.readline().startswith("read h")
        guard.cancel()
        assert (
            "thread 0 blocks outside of the simulation, in read (descriptor 0, pipe:"
            in child.stderr.read()
        )
    assert child.returncode == 0


def test_a_signal_from_outside_wakes_whom_its_handler_posts_to(programs: Programs) -> None:
    library = {
        "LD_PRELOAD": str(programs.folder / "libtry.so"),
        "RSLTRACE_LONE": "1",
        "RSLTRACE_PATIENCE": "300",
    }
    with subprocess.Popen(
        [str(programs.folder / "corner_cases"), "signal_from_outside"],
        env=os.environ | library,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout
        assert child.stdout.readline() == "0 ready\n"
        child.send_signal(signal.SIGTERM)
        assert child.stdout.readline() == "0 posted\n"
    assert child.returncode == 0
