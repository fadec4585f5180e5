"""Random generators by name: each node draws from its own, so one more node changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any


class RandomStreams:
    """The generators of one run, by name: made when first used, seeded by the job's seed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        """The job's."""
        self._random: dict[str, Random] = {}
        self._entropy: dict[str, Random] = {}
        self._numpy: dict[str, Any] = {}
        self.last_uuid: dict[str, int | None] = {}
        self.file_names: dict[str, Any] = {}
        self._begun: dict[str, str] = {}

    def begin(self, name: str, entropy: Callable[[], str]) -> None:
        """Let a node's streams begin with entropy from outside, the first time it draws."""
        if name not in self._begun:
            self._begun[name] = ""  # in case asking for it draws
            self._begun[name] = entropy()

    def _seed_of(self, name: str) -> str:
        entropy = self._begun.get(name)
        return f"{self.seed} {entropy}" if entropy else str(self.seed)

    def random(self, name: str) -> Random:
        """Return the stand-in for the generator behind ``random``'s functions."""
        found = self._random.get(name)
        if found is None:
            found = self._random[name] = Random(f"random {self._seed_of(name)} {name}")
        return found

    def entropy(self, name: str, size: int) -> bytes:
        """Return the next bytes in place of the operating system's."""
        found = self._entropy.get(name)
        if found is None:
            found = self._entropy[name] = Random(f"entropy {self._seed_of(name)} {name}")
        return found.randbytes(size)

    def numpy(self, name: str) -> Any:
        """Return the stand-in for the generator behind ``numpy.random``'s functions."""
        found = self._numpy.get(name)
        if found is None:
            import numpy as np

            seed = Random(f"numpy {self._seed_of(name)} {name}").getrandbits(32)
            found = self._numpy[name] = np.random.RandomState(seed)
        return found
