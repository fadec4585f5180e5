"""What a planted fault is, and the register of its classes."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from campaigns.truth.graph import Callback, NodePlan, World
from campaigns.truth.recordings import Recordings

ALWAYS_FALSE = (
    r"different number of times",
    r"random draws differ",
    r"told to stop, or had no more to do",
)
"""What no planted fault but one of chance may be blamed on."""

NOT_DETERMINISTIC = r"not deterministic"
STATE_HINT = r"guard: \{state: record\}"


@dataclass(frozen=True)
class Truth:
    """What is true of two runs, whatever ``diff`` says of them.

    ``verdicts`` are those that are right; ``node`` and ``entity`` lead (full name; "" where that is
    not known). ``says`` are regular expressions that hold for first line and cause together,
    ``first`` for the first line alone, ``never`` for neither; ``shows`` hold for the report.
    ``values``: a topic; the first line names the two values of its first message that differs.
    """

    verdicts: tuple[str, ...] = ()
    node: str = ""
    entity: str = ""
    first: tuple[str, ...] = ()
    says: tuple[str, ...] = ()
    never: tuple[str, ...] = ALWAYS_FALSE
    shows: tuple[str, ...] = ()
    values: str = ""
    equal: bool = False
    exit_code: int | None = None
    independent: int | None = 1
    """How many independent divergences there are; None where that is not known."""


@dataclass(frozen=True)
class Planted:
    """Two worlds and the truth about them; or two recordings, and the truth about these."""

    a: World
    b: World
    truth: Truth
    recordings: Recordings | None = None


Planter = Callable[[random.Random], Planted]
FAULTS: dict[str, Planter] = {}
FAMILIES: dict[str, str] = {}
"""The module of each class, by name."""


def fault(name: str) -> Callable[[Planter], Planter]:
    """Register a class of faults."""

    def register(planter: Planter) -> Planter:
        add(name, planter, planter)
        return planter

    return register


def add(name: str, planter: Planter, made_by: Callable[..., object]) -> None:
    """Register a class of faults in the family of the module that ``made_by`` is of."""
    assert name not in FAULTS
    FAULTS[name] = planter
    FAMILIES[name] = made_by.__module__.rpartition(".")[2]


def insert(callback: Callback, mark: str, lines: list[str]) -> None:
    """Put lines in front of a mark of a callback, as far in as the mark."""
    at = next(i for i, line in enumerate(callback.lines) if line.strip() == mark)
    indent = callback.lines[at].partition("#")[0]
    callback.lines[at:at] = [f"{indent}{line}" for line in lines]


def in_code(
    a: World,
    node: str,
    lines: list[str],
    *,
    mark: str = "# before",
    at: int | str | None = None,
    method: str = "",
) -> World:
    """Return a world whose node does something else: its code is another one.

    ``at`` is the number of the call, or a condition; ``method`` the callback, else the first.
    """
    b = a.copy()
    insert(b.node(node).callback(method), mark, _guarded(lines, at, ""))
    return b


def in_hiding(
    a: World,
    node: str,
    lines: list[str],
    *,
    mark: str = "# before",
    at: int | str | None = None,
    method: str = "",
) -> World:
    """Return a world whose node does something else with the same code; changes ``a``, too."""
    callback = a.node(node).callback(method)
    insert(callback, mark, _guarded(lines, at, 'hidden() == "fault"'))
    b = a.copy()
    b.hidden = "fault"
    return b


def _guarded(lines: list[str], at: int | str | None, condition: str) -> list[str]:
    conditions = [condition] if condition else []
    if at is not None:
        conditions.append(at if isinstance(at, str) else f"self.n == {at}")
    if not conditions:
        return lines
    return [f"if {' and '.join(conditions)}:", *(f"    {line}" for line in lines)]


def one_of(rng: random.Random, world: World, *roles: str) -> NodePlan:
    """Return a node that has one of these roles."""
    return rng.choice([node for node in world.nodes if node.role in roles])


def module_of(node: NodePlan) -> str:
    """Return a regular expression for a cause that names the code of a node."""
    return rf"{node.module}"
