"""PyTorch's generator, for each node as if it were alone in the process.

Torch draws in C++ from one generator, and offers no place to ask who is calling. So the generator's
state is exchanged whenever another node's code begins to run: some 10 microseconds each time, in
jobs that have loaded torch and in no others.
"""

from __future__ import annotations

import os
import random
import sys
from contextlib import ExitStack
from typing import Any

from rsltrace.guard.extension_types import exchange
from rsltrace.guard.guard import Guard


class TorchStreams:
    """The states of torch's generator, by the name of the node (or of the entry) that draws."""

    def __init__(self, generator: Any, seed: int) -> None:
        self._generator = generator
        self._seed = seed
        self._states: dict[str, Any] = {}
        self._name: str | None = None

    def enter(self, name: str) -> None:
        """Go on where a node's code has stopped drawing."""
        if name == self._name:
            return
        self._keep()
        self._name = name
        state = self._states.get(name)
        if state is not None:
            self._generator.set_state(state)
        else:
            self._generator.manual_seed(random.Random(f"torch {self._seed} {name}").getrandbits(63))

    def rename(self, name: str) -> None:
        """Go on under another name: an entry has made its node, and may have seeded before."""
        self._keep()
        self._name = name

    def _keep(self) -> None:
        if self._name is not None:
            self._states[self._name] = self._generator.get_state()


def _seeding(real: Any) -> Any:
    def seed(self: Any) -> int:
        """Do ``Generator.seed``, which would take entropy in C++."""
        value = int.from_bytes(os.urandom(8), "big") >> 1
        self.manual_seed(value)
        return value

    return seed


def torch_streams(stack: ExitStack, guard: Guard) -> TorchStreams:
    """Divide the generator of torch, which is loaded, among the nodes until ``stack`` ends."""
    torch: Any = sys.modules["torch"]
    generator = torch.default_generator
    stack.callback(generator.set_state, generator.get_state())
    exchange(stack, torch._C.Generator, "seed", _seeding)
    return TorchStreams(generator, guard.streams.seed)
