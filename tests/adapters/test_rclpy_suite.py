"""The harness that runs rclpy's own tests: what it reports can be believed."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
SUITE = ROOT / "campaigns" / "rclpy_suite"

# A checkout of something like rclpy.
MODULE = """
import ctypes, threading, time, unittest
import pytest, rclpy
from rclpy.executors import SingleThreadedExecutor

class TestAll(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.context = rclpy.Context()
        rclpy.init(context=cls.context)
        cls.node = rclpy.create_node('all', context=cls.context)
        cls.executor = SingleThreadedExecutor(context=cls.context)
        cls.executor.add_node(cls.node)

    def test_a_spins_for_an_hour(self):
        ticks = []
        timer = self.node.create_timer(60.0, lambda: ticks.append(1))
        start = time.monotonic()
        while time.monotonic() - start < 3601.0:
            self.executor.spin_once(timeout_sec=100.0)
        self.assertGreaterEqual(len(ticks), 60)

    def test_b_fails(self):
        assert self.node.get_name() == 'nobody'

    def test_c_hangs(self):
        threading.Event().wait()

    def test_d_crashes(self):
        ctypes.string_at(0)

    def test_e_is_skipped(self):
        pytest.skip('not today')

    def test_f_passes_after_all_that(self):
        assert rclpy.__file__.endswith('__init__.py')
        from rclpy.impl.implementation_singleton import rclpy_implementation as real
        assert real.rclpy_get_rmw_implementation_identifier() == 'rmw_rsltrace'
"""


def harness(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SUITE), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=1500,
    )


@pytest.mark.long
def test_every_outcome_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "rclpy" / "test"
    folder.mkdir(parents=True)
    (folder / "test_node.py").write_text(MODULE)
    (folder / "__init__.py").write_text("raise ImportError('needs a build folder')\n")
    done = harness("--rclpy", tmp_path, "--list", tmp_path / "passed.txt", "--timeout", 500)
    assert done.returncode == 1, done.stdout + done.stderr
    said = done.stdout
    name = "test/test_node.py::TestAll::test_"
    assert "test_node.py: 2 of 6" in said
    assert f"failed {name}b_fails: call: AssertionError: assert 'all' == 'nobody'" in said
    assert (
        f"hung {name}c_hangs: deadlock: nothing can happen any more, and these calls still wait"
        in said
    )
    assert f"crashed {name}d_crashes: the process ended with status -11" in said
    assert f"skipped {name}e_is_skipped" in said
    assert (tmp_path / "passed.txt").read_text().split() == [
        f"{name}a_spins_for_an_hour",
        f"{name}f_passes_after_all_that",
    ]
    assert "6 tests: 2 pass in the simulation, 0 excluded with a reason, 4 fail" in said


def test_what_is_no_checkout_is_refused(tmp_path: Path) -> None:
    done = harness("--rclpy", tmp_path)
    assert done.returncode == 1
    assert "is no checkout of rclpy" in done.stderr


def loaded(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"suite_{name}", SUITE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # for its dataclasses
    spec.loader.exec_module(module)
    return module


def test_the_document_is_that_of_the_table() -> None:
    document, excluded = loaded("document"), loaded("excluded").EXCLUDED
    text = (ROOT / "docs" / "qualification" / "rclpy-tests.md").read_text()
    version, both = document.read(text)
    assert text == document.document(version, both, excluded)
    for way, counts in both.items():
        assert counts.suite == counts.passed + counts.excluded + counts.failed
        assert counts.excluded == len(excluded[way])
        assert counts.failed == 0


# Something like a gtest executable. What it prints depends on whether it is in a simulation.
GTEST = r"""#!/bin/sh
list='Some.\n  passes\n  dies  # GetParam() = 1\n  DISABLED_x\n'
case "$1" in --gtest_list_tests) printf "$list"; exit;; esac
case "$1" in *passes*) printf '[ RUN      ] Some.passes\n[       OK ] Some.passes (0 ms)\n';; esac
case "$1" in *dies*) printf '[ RUN      ] Some.dies\n';; *) exit;; esac
case "$BLIS_NUM_THREADS" in 1) echo 'a.cpp:1: Failure'; exit 7;; esac
printf '[       OK ] Some.dies (0 ms)\n'
"""


@pytest.mark.long
def test_a_gtest_that_passes_natively_only_is_named(tmp_path: Path) -> None:
    program = tmp_path / "build" / "test_some"
    program.parent.mkdir()
    program.write_text(GTEST)
    program.chmod(0o755)
    command = [sys.executable, str(SUITE.with_name("gtests")), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 1, done.stderr
    assert "test_some: 2 of 2 natively, 1 in rsltrace" in done.stdout
    assert "Some.dies: rsltrace: error: process " in done.stdout
    assert "a.cpp:1: Failure" in done.stdout
    assert (
        "2 tests: 2 pass natively, 1 of these in rsltrace; 0 are known to differ, 1 are not"
        in done.stdout
    )
