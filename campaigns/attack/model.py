"""The values of the attack: what is tried, what came of it, and what was wrong with that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

MIB = 1 << 20


class Wrong(str, Enum):
    """What an outcome can be blamed for: a closed set."""

    DIED = "died"  # of a signal nobody sent: a crash, or a limit of the operating system
    STATUS = "status"  # not one of the documented exit statuses
    TRACEBACK = "traceback"  # of our own code
    UNNAMED = "unnamed"  # an error that names neither file nor entity
    RAW = "raw"  # a control character on stdout or stderr
    CPU = "cpu"
    MEMORY = "memory"
    HANG = "hang"
    EXECUTED = "executed"  # the canary: code ran that must not
    SECRET = "secret"  # a password or signature on stdout or stderr
    ANSWER = "answer"  # something was told that is not so
    FORGED = "forged"  # the same, although --check says that it has read everything
    BROKEN = "broken"  # the attack itself failed
    LOST = "lost"  # what was said to be kept is not there
    LEFT = "left"  # a process that goes on after its command


@dataclass(frozen=True)
class Limits:
    """What one command may take. CPU rather than wall time: a loaded machine answers alike.

    ``wall_s`` is only there to end what waits for ever. ``address_mib`` is what the kernel grants;
    it is far above ``rss_mib`` because libraries reserve what they never touch.
    """

    cpu_s: float = 10.0
    rss_mib: int = 700
    address_mib: int = 6144
    wall_s: float = 600.0
    file_bytes: int | None = None


@dataclass(frozen=True)
class Kill:
    """A signal from outside, once the files in the case's folder have grown by ``grown_bytes``."""

    signal: int
    grown_bytes: int = 0
    delay_s: float = 0.0


@dataclass(frozen=True)
class Command:
    """One call of ``rsltrace``, in a fork of a process that has it loaded, or in a new one.

    ``stdout`` and ``stderr`` are "file" (and read by the oracle), "full" (/dev/full) or "closed".
    ``allowed`` are the exit statuses that are documented for it; negative ones are signals.
    ``program`` is run instead of rsltrace, where something has to be around it. ``client`` is
    called in a process of its own, with the command's id, while that runs: it attacks and ends it.
    """

    words: tuple[str, ...]
    allowed: frozenset[int]
    cwd: Path
    fresh: bool = False
    stdout: str = "file"
    stderr: str = "file"
    limits: Limits = Limits()
    kill: Kill | None = None
    environment: tuple[tuple[str, str], ...] = ()
    program: tuple[str, ...] = ()
    user: int | None = None
    client: Callable[[int], None] | None = None


@dataclass(frozen=True)
class Ran:
    """How a command ended. A negative ``status`` is the signal it died of.

    ``left`` is how many processes it has left behind, half a minute after its end.
    """

    command: Command
    status: int
    stdout: bytes
    stderr: bytes
    cpu_s: float
    rss_mib: float
    wall_s: float
    timed_out: bool = False
    killed: bool = False
    left: int = 0

    @property
    def line(self) -> str:
        """The command as one types it."""
        return " ".join(("rsltrace", *self.command.words))


@dataclass(frozen=True)
class Complaint:
    """One thing that was wrong, with as much as is needed to see it."""

    wrong: Wrong
    text: str
    command: str = ""


Judge = Callable[[Sequence[Ran]], list[Complaint]]


@dataclass
class Case:
    """One attack: a folder with files, commands to run in turn, and what must hold afterwards.

    An error must have one of ``names`` in it (the file attacked, or its part). ``secrets`` must
    not be printed. ``user_code`` says that nodes run, whose own tracebacks are theirs.
    ``judge`` knows the right answer, as far as there is one besides an error.
    """

    folder: Path
    commands: list[Command] = field(default_factory=list)
    names: tuple[str, ...] = ()
    secrets: tuple[str, ...] = ()
    user_code: bool = False
    judge: Judge | None = None
    skipped: str = ""
    note: str = ""
    cleanup: list[Callable[[], None]] = field(default_factory=list)

    @property
    def canary(self) -> Path:
        """What code writes that must not run."""
        return self.folder / "canary"


@dataclass(frozen=True)
class Verdict:
    """What a case came to."""

    family: str
    attack: str
    seed: int
    outcomes: tuple[str, ...]
    complaints: tuple[Complaint, ...]
    cpu_s: float
    cpu_s_max: float
    rss_mib_max: float
    wall_s: float
    skipped: str = ""
    note: str = ""

    @property
    def keys(self) -> frozenset[str]:
        """What ``known`` calls its complaints."""
        return frozenset(
            f"{self.family}/{self.attack}: {complaint.wrong.value}" for complaint in self.complaints
        )

    @property
    def reproducer(self) -> str:
        """The one line that does it again."""
        return f"python -m campaigns.attack --family {self.family} --seed {self.seed}"
