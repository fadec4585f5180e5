"""What families share: a case from a seed, and the commands that read a trace."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random

from campaigns.attack.corpus import Corpus
from campaigns.attack.model import Case

Attack = Callable[[Random, Case, Corpus], None]
"""Fills a case (its files, commands, what must hold) from a random stream."""


@dataclass(frozen=True)
class Family:
    """Generators of one kind. The seed chooses the attack in turn, so that few seeds cover all."""

    name: str
    attacks: Mapping[str, Attack]
    slow: frozenset[str] = frozenset()
    """Attacks that wait: not for the slice in ``make test``."""
    sliced: frozenset[str] = frozenset()
    """The attacks of the slice, if not all that are not slow."""
    rounds: int = 1
    """How often the slice tries each."""
    ros: bool = False
    """Whether nodes run."""

    def attack_of(self, seed: int) -> str:
        """Return the name of the attack that a seed stands for."""
        return list(self.attacks)[seed % len(self.attacks)]

    def in_slice(self, seed: int) -> bool:
        """Return whether ``make test`` may try a seed."""
        attack = self.attack_of(seed)
        return attack in self.sliced if self.sliced else attack not in self.slow

    def case(self, seed: int, folder: Path, corpus: Corpus) -> Case:
        """Make the case of a seed in an empty folder: the same files for the same seed."""
        attack = self.attack_of(seed)
        case = Case(folder)
        self.attacks[attack](stream(self.name, seed), case, corpus)
        return case


def stream(*parts: object) -> Random:
    """Return a random stream that is a function of its name alone."""
    return Random(":".join(map(str, parts)))
