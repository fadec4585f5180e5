"""Torch's one generator, divided among the nodes; with torch where it is installed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.guard.conftest import node_code

pytestmark = pytest.mark.ros

STAND_IN = """
import os, random
class Generator:
    def __init__(self): self.state = random.SystemRandom().getrandbits(60)
    def manual_seed(self, seed): self.state = seed; return self
    def seed(self): self.state = random.SystemRandom().getrandbits(60); return self.state
    def get_state(self): return self.state
    def set_state(self, state): self.state = state
    def draw(self):
        self.state = (self.state * 6364136223846793005 + 1442695040888963407) % 2**64
        return self.state
class _C: Generator = Generator
default_generator = Generator()
manual_seed = default_generator.manual_seed
def seed(): return default_generator.seed()
class rand:
    def __init__(self, count): self.drawn = [default_generator.draw() for _ in range(count)]
    def tolist(self): return self.drawn
"""
"""As much of torch as the guard knows."""


@pytest.fixture(params=["stand-in", "torch"])
def torch(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return how a node's module imports it: anew in each run, or (the real one) once."""
    if request.param == "torch":
        pytest.importorskip("torch")
        return "import torch"
    (tmp_path / "torch.py").write_text(STAND_IN)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    return "import sys; sys.modules.pop('torch', None)\nimport torch"


DRAW = "self.say(torch.rand(3).tolist(), torch.rand(1).tolist())"
Said = Callable[..., list[Any]]


@pytest.mark.few(1)
def test_torch_draws_the_same_in_every_run(said: Said, torch: str) -> None:
    code = node_code(DRAW, imports=torch)
    first = said(code)
    assert said(code) == first
    assert first[0] != first[1]
    assert said(code, job="nodes: [{node: 'm:N'}]\nseed: 1") != first
    off = "nodes: [{node: 'm:N'}]\nguard: false"
    if "sys" in torch:
        assert said(code, job=off) != said(code, job=off), "it proves nothing"


def test_one_more_node_does_not_disturb_torch_in_the_others(said: Said, torch: str) -> None:
    code = node_code(DRAW, imports=torch)
    alone = said(code)
    extra = "nodes: [{node: 'm:N', name: first}, {node: 'm:N'}, {node: 'm:N', name: last}]"
    together = said(code, job=extra)
    assert [together[1], together[4]] == alone
    assert together[0] != alone[0] != together[2]


@pytest.mark.long
def test_a_seed_of_the_nodes_own_is_its_own_in_torch(said: Said, torch: str) -> None:
    code = node_code(DRAW, imports=torch, init="if self.get_name() == 'n': torch.manual_seed(5)")
    alone = said(code)
    assert said(code, job="nodes: [{node: 'm:N'}, {node: 'm:N', name: b}]\nseed: 9")[0] == alone[0]
    before = code.replace("super()", "torch.manual_seed(5); super()")
    assert said(before)[0] == alone[0], "before the node has a name, too"


def test_torch_that_is_loaded_late_and_seeded_by_chance(said: Said, torch: str) -> None:
    code = node_code(f"{torch}\ntorch.seed()\n{DRAW}")
    assert said(code) == said(code)


GRAPH = """
def weighed(x):
    first, second = x, x + 1
    for name in {"aa", "b", "ccc"}:
        first = first * len(name)
    names = ["a", "b"]
    names.pop()
    return max(len(names), 0) * first.sum() + sum([second.sum() for _ in range(2)]), f"{len(names)}"
"""


def test_code_with_sets_in_order_is_one_graph(said: Said) -> None:
    """``fullgraph``: nothing in it is left to Python. (Twice: it is told for good.)"""
    pytest.importorskip("torch")
    tick = "total, text = torch.compile(weighed, backend='eager', fullgraph=True)(torch.ones(2))\n"
    code = node_code(tick + "self.say(float(total), text)", imports="import torch", module=GRAPH)
    assert said(code) == said(code) == [[20.0, "1"]] * 2
