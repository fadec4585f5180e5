"""The determinism network's nodes compute what RSLCPP's C++ nodes do, in the order it publishes."""

from __future__ import annotations

import lzma
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

TESTS = Path(__file__).resolve().parents[1]
GOLDEN_ORDER = TESTS / "golden" / "rslcpp_callback_order_creation.txt.xz"

FINAL_STATES = (13404255130693361018, 6314714395288068323, 271694970909356762, 18227695353861151360)
COMBINED = 14807076229895937644
CALLBACKS = 19_011


@pytest.fixture
def nodes(sim: Any, load_example: Callable[[str, str], ModuleType]) -> ModuleType:
    return load_example("rslcpp_determinism", "nodes")


def run_network(sim: Any, nodes: ModuleType, *, keep_order: bool) -> list[Any]:
    classes = (nodes.NodeA, nodes.NodeB, nodes.NodeC, nodes.NodeD)
    network = [make(keep_order=keep_order) for make in classes] + [nodes.Monitor()]
    sim.run(10_000_000_000, lambda: bool(sim.counts["/rslcpp/error_code"]))
    for node in network:
        node.destroy_node()
    return network


def test_network_ends_in_the_states_of_the_cpp_program(sim: Any, nodes: ModuleType) -> None:
    network = run_network(sim, nodes, keep_order=True)
    assert len(nodes.EXECUTED) == CALLBACKS
    assert tuple(node.state for node in network[:4]) == FINAL_STATES
    assert sim.now == 110_000_000_000
    assert sim.logs == [
        *(f"node_{name}: final state {s}" for name, s in zip("abcd", FINAL_STATES, strict=True)),
        f"monitor: combined hash {COMBINED}",
    ]


@pytest.mark.long
def test_callbacks_run_in_the_order_of_the_cpp_program(sim: Any, nodes: ModuleType) -> None:
    run_network(sim, nodes, keep_order=True)
    with lzma.open(GOLDEN_ORDER, "rt") as lines:
        golden = [int(line) for line in lines]
    assert golden == nodes.EXECUTED


def test_a_second_network_in_one_process_starts_afresh(sim: Any, nodes: ModuleType) -> None:
    run_network(sim, nodes, keep_order=True)
    sim.__dict__.update(type(sim)().__dict__)
    run_network(sim, nodes, keep_order=False)
    assert sim.logs[-1] == f"monitor: combined hash {COMBINED}"
    assert nodes.EXECUTED == []


def test_the_monitor_publishes_its_exit_code_once(sim: Any, nodes: ModuleType) -> None:
    monitor = nodes.Monitor(seconds=3)
    sim.run(0, lambda: sim.now >= 9_000_000_000)
    assert [(topic, m.data) for topic, m in sim.published] == [("/rslcpp/error_code", 0)]
    monitor.destroy_node()
    monitor.destroy_node()
    assert len(sim.logs) == 1


def mix_as_specified(h1: int, h2: int) -> int:
    """The formula of the oracle's README, step by step and without short cuts."""
    top, k = 2**64, 0x9DDFEA08EB382D69
    a = (h1 ^ h2) * k % top
    a ^= a >> 47
    b = (h2 ^ a) * k % top
    b ^= b >> 47
    x = (b * k % top + 0x9E3779B97F4A7C15) % top
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 % top
    x = (x ^ x >> 27) * 0x94D049BB133111EB % top
    return x ^ x >> 31


def test_mix_is_the_formula_written_down(nodes: ModuleType) -> None:
    word = st.integers(0, 2**64 - 1)

    @settings(deadline=None)
    @given(word, word)
    def check(h1: int, h2: int) -> None:
        assert nodes.mix(h1, h2) == mix_as_specified(h1, h2)

    check()
