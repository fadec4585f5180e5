"""What reading a launch file gives: nodes to simulate, and what cannot be simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rsltrace.adapters.launch.scope import Parameters, full_name
from rsltrace.trace.model.printable import printable

ENVIRONMENT = (
    "{where}: environment variable {name}: it counts for the launch file and for processes; nodes "
    "in rsltrace's process see the environment that it was started with"
)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a launch file says of the process of a node: where it runs, and when again.

    ``environment`` is what differs from that of the launch file; ``own`` names what of these is
    said for the process alone, ``without`` what processes are not given here (``launch-prefix``).
    ``respawn`` is how much later (ns) it starts again, and how often at most.
    """

    environment: tuple[tuple[str, str], ...] = ()
    folder: str = ""
    respawn: tuple[int, int | None] | None = None
    own: tuple[str, ...] = ()
    without: tuple[str, ...] = ()


def respawning(delay_s: float, times: int) -> tuple[int, int | None] | None:
    """Return ``Surroundings.respawn`` as launch files say it; negative ``times``: no limit."""
    return None if times == 0 else (round(max(delay_s, 0) * 1e9), None if times < 0 else times)


@dataclass(frozen=True, slots=True)
class LaunchedNode:
    """A node that a launch file starts.

    ``executable`` is that of ``package``; a component has a ``plugin`` instead, and the full name
    of a ``container`` that loads it. ``name`` and
    ``namespace`` are None where the launch file leaves them to the node. ``where`` is
    ``file:line:column``, as far as it is known. It starts ``delay_ns`` after the launch file
    (``<timer>``); or, if there is an ``after``, after the node with that ``number`` has ``started``
    or ``ended``. ``fault`` is what is wrong with it, should it not be left out.
    """

    where: str
    package: str
    executable: str = ""
    plugin: str = ""
    name: str | None = None
    namespace: str | None = None
    parameters: Parameters = ()
    remappings: tuple[tuple[str, str], ...] = ()
    arguments: tuple[str, ...] = ()
    ros_arguments: tuple[str, ...] = ()
    delay_ns: int = 0
    after: tuple[str, int] | None = None
    number: int = 0
    fault: str = ""
    surroundings: Surroundings = Surroundings()
    is_container: bool = False
    container: str = ""
    extra_arguments: Parameters = ()

    @property
    def full_name(self) -> str:
        """Its name with its namespace, as far as the launch file says it."""
        return full_name(self.namespace, self.name or "")

    @property
    def title(self) -> str:
        """How to call it in a message."""
        what = f"{self.package}/{self.executable or self.plugin}"
        return printable(f"{what} ({self.name})" if self.name else what)


@dataclass(frozen=True, slots=True)
class Unsupported:
    """Something in a launch file that cannot be simulated, and why."""

    where: str
    what: str
    why: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}: {self.why}"


@dataclass(frozen=True, slots=True)
class Argument:
    """A declared launch argument; ``default`` is as written, None for a required one."""

    name: str
    default: str | None = None
    description: str = ""

    def __str__(self) -> str:
        value = "required" if self.default is None else f"default {self.default!r}"
        return f"{self.name} ({value}{', ' + self.description if self.description else ''})"


def argument_words(arguments: Mapping[str, str]) -> list[str]:
    """Return launch arguments as words of a command line: launch files look at these, too."""
    return [f"{name}:={value}" for name, value in arguments.items()]


@dataclass(slots=True)
class Launched:
    """All of a launch file. ``ignored`` is what has no meaning in a simulation, for information.
    Where a node of which ``required`` has the number ends, everything does."""

    nodes: list[LaunchedNode] = field(default_factory=list)
    unsupported: list[Unsupported] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    arguments: dict[str, Argument] = field(default_factory=dict)
    required: set[int] = field(default_factory=set)
