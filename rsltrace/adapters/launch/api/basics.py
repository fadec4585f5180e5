"""What every launch file is made of: substitutions, conditions, actions, and the context of all."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.model import (
    LaunchArgument,
    LaunchResult,
    LaunchScope,
    UnsupportedItem,
    truth,
)
from rsltrace.errors import JobError
from rsltrace.job.reading.yaml_source import SourcePlace

_OWN = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))
NOWHERE = "/package-not-found"
"""The prefix of packages that are not there."""
WHY = "it is neither installed nor among the sources here"


class SubstitutionFailure(RuntimeError):
    """A substitution cannot be replaced by text."""


class Substitution:
    """Something that becomes text when it is needed."""

    def describe(self) -> str:
        """Return how to call it in a message."""
        return type(self).__name__

    def perform(self, context: LaunchContext) -> str:
        raise NotImplementedError(f"{type(self).__name__} has no perform()")


class TextSubstitution(Substitution):
    """A plain text."""

    def __init__(self, *, text: str) -> None:
        if not isinstance(text, str):
            raise TypeError(f"TextSubstitution takes text, not {type(text).__name__}")
        self.text = text

    def describe(self) -> str:
        return self.text

    def perform(self, context: LaunchContext) -> str:
        return self.text


def as_substitutions(given: Any) -> list[Substitution]:
    """Return substitutions for text, a substitution, or a sequence of both.

    :raises TypeError: if it is anything else.
    """
    if isinstance(given, (str, Substitution)):
        given = [given]
    elif isinstance(given, os.PathLike):
        given = [os.fspath(given)]
    if not isinstance(given, Iterable):
        raise TypeError(f"expected text or substitutions, got {type(given).__name__} ({given!r})")
    found: list[Substitution] = []
    for part in given:
        if isinstance(part, Substitution):
            found.append(part)
        elif isinstance(part, str):
            found.append(TextSubstitution(text=part))
        else:
            raise TypeError(
                f"expected text or a substitution, got {type(part).__name__} ({part!r})"
            )
    return found


def perform_substitutions(context: LaunchContext, substitutions: Iterable[Substitution]) -> str:
    """Return the text that substitutions stand for, one after the other."""
    return "".join(context.perform_substitution(part) for part in substitutions)


class LaunchContext:
    """What a launch file can see while it is read, and what it has started (``launched``).

    ``delay_ns`` is when what is being read happens after the start of the launch file; or, with
    ``after``, after the action of that number has ``started`` or ``ended``. ``kept`` keeps the
    actions alive whose ``id`` is a number.
    """

    def __init__(
        self,
        *,
        argv: Sequence[str] | None = None,
        noninteractive: bool = True,
        arguments: Mapping[str, str] | None = None,
    ) -> None:
        self.argv = list(argv or ())
        self.noninteractive = noninteractive
        self.launched = LaunchResult()
        self.scope = LaunchScope(configurations=dict(arguments or {}))
        self.file = Path()
        """The launch file being read."""
        self.delay_ns = 0
        self.after: tuple[str, int] | None = None
        self.kept: list[object] = []
        self.later: list[Callable[[], None]] = []
        """What happens once the launch file has been read: event handlers."""
        self.include: Callable[[Path], None] | None = None
        self.where = ""
        """Where the action is that is being done."""
        self.first_environment = dict(self.scope.environment)
        self._anonymous: dict[str, str] = {}

    @contextmanager
    def within(
        self, *, scope: LaunchScope | None = None, file: Path | None = None
    ) -> Iterator[None]:
        """Read in another scope, or another file, within the block."""
        outer = self.scope, self.file
        self.scope, self.file = scope or self.scope, file or self.file
        try:
            yield
        finally:
            self.scope, self.file = outer

    def anonymous(self, name: str) -> str:
        """Return a unique name that begins with ``name``."""
        # ROS appends host, process and a random number; here runs must not differ.
        return self._anonymous.setdefault(name, f"{name}_{len(self._anonymous) + 1}")

    def changed_environment(self) -> dict[str, str]:
        """Return what the launch file has set in the environment that it found."""
        return {
            name: value
            for name, value in self.scope.environment.items()
            if self.first_environment.get(name) != value
        }

    @property
    def launch_configurations(self) -> dict[str, str]:
        """The launch arguments, as text."""
        return self.scope.configurations

    @property
    def environment(self) -> dict[str, str]:
        """The environment that processes would get."""
        return self.scope.environment

    def perform_substitution(self, substitution: Substitution) -> str:
        return substitution.perform(self)

    def text(self, given: Any) -> str:
        """Return what text or substitutions stand for."""
        return perform_substitutions(self, as_substitutions(given))

    def optional(self, given: Any) -> str | None:
        """Return what text or substitutions stand for, None for None."""
        return None if given is None else self.text(given)

    def flag(self, given: Any) -> bool:
        """Return whether a truth value, or what stands for one, is true."""
        return given if isinstance(given, bool) else truth(self.text(given))

    def refuse(self, where: str, what: str, why: str) -> None:
        """Note that something cannot be simulated."""
        self.launched.unsupported.append(UnsupportedItem(where, what, why))


class Condition:
    """Whether an action is done; ``predicate`` is asked."""

    def __init__(self, *, predicate: Callable[[LaunchContext], bool] | None = None) -> None:
        self._predicate_func = predicate

    def evaluate(self, context: LaunchContext) -> bool:
        return True if self._predicate_func is None else bool(self._predicate_func(context))


class LaunchDescriptionEntity:
    """Anything that a launch description holds."""

    def visit(self, context: LaunchContext) -> None:
        raise NotImplementedError(f"{type(self).__name__} has no visit()")

    def inside(self) -> Iterable[Any]:
        """Give what is known to be in it before it is visited."""
        return ()


class Action(LaunchDescriptionEntity):
    """Something to do, if its condition holds. ``where`` is where the launch file makes it,
    ``place`` the same in XML or YAML."""

    def __init__(self, *, condition: Condition | None = None) -> None:
        self._condition = condition

    def __new__(cls, *_: Any, **__: Any) -> Action:
        """Note where it is made: subclasses of others may never call ``Action.__init__``."""
        action = super().__new__(cls)
        action.where = calling_line()
        action._condition = None
        return action

    where: str
    place: SourcePlace | None = None
    _condition: Condition | None

    @property
    def condition(self) -> Condition | None:
        """When it is done; None: always."""
        return self._condition

    def visit(self, context: LaunchContext) -> None:
        """Do it if its condition holds, and what it gives to be done after it."""
        outer, context.where = context.where, self.where
        try:
            if self._condition is not None and not self._condition.evaluate(context):
                return
            brought = self.execute(context)
            if brought is not None:
                visit_all(context, brought)
        except Exception as error:
            if self.place is None:
                raise as_job_error(error, self.where) from error
            found = as_job_error(error, "")
            raise (found if found.where else self.place.error(str(found))) from error
        finally:
            context.where = outer

    def execute(self, context: LaunchContext) -> Any:
        """Do it; return what is to be visited after it, or None."""
        raise NotImplementedError(f"{type(self).__name__} has no execute()")


class LaunchDescription(LaunchDescriptionEntity):
    """Actions in order."""

    def __init__(
        self, initial_entities: Iterable[Any] | None = None, *, deprecated_reason: str | None = None
    ) -> None:
        self.entities: list[Any] = list(initial_entities or ())

    def add_action(self, action: Any) -> None:
        """Put an action at the end."""
        self.entities.append(action)

    add_entity = add_action

    def inside(self) -> Iterable[Any]:
        return self.entities

    def visit(self, context: LaunchContext) -> None:
        """Do all of them; what they declare is known from the beginning."""
        note_arguments(context, self)
        visit_all(context, self.entities)


def visit_all(context: LaunchContext, entities: Any) -> None:
    for entity in entities:
        if not isinstance(entity, LaunchDescriptionEntity):
            raise TypeError(
                f"a launch description holds actions, and here is {type(entity).__name__}: "
                f"{entity!r:.80}"
            )
        entity.visit(context)


def note_arguments(context: LaunchContext, entity: LaunchDescriptionEntity) -> None:
    """Note what an entity declares, and what is in it does."""
    declared: LaunchArgument | None = getattr(entity, "argument", None)
    if declared is not None:
        context.launched.arguments.setdefault(declared.name, declared)
    for inner in entity.inside():
        if isinstance(inner, LaunchDescriptionEntity):
            note_arguments(context, inner)


def calling_line() -> str:
    """Return file and line of the nearest caller that is not of rsltrace."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith((_OWN, "<frozen ")):
        frame = frame.f_back
    return f"{shown(frame.f_code.co_filename)}:{frame.f_lineno}"


def shown(path: str) -> str:
    """Return a path as messages have it: from the present folder, if it is below that."""
    path = os.path.realpath(path) if os.path.isabs(path) else path  # shares are links to sources
    below = path.startswith(os.path.join(os.getcwd(), ""))
    return os.path.relpath(path) if below else path


def missing_package(path: str | os.PathLike[str]) -> str | None:
    """Return the package that a path lies in, if it is one that is not there."""
    parts = Path(path).parts
    is_missing = len(parts) > 3 and os.path.join(*parts[:2]) == NOWHERE
    return parts[3] if is_missing else None


def _missing_file(error: BaseException) -> str | None:
    """Return what to say of an error if it is about a file of a package that is not there."""
    file = error.filename if isinstance(error, OSError) else None
    package = missing_package(file) if isinstance(file, str) else None
    return None if package is None else f"there is no package {package!r}: {WHY}"


def as_job_error(error: BaseException, where: str) -> JobError:
    """Return what went wrong in a launch file as an error of the job, with file and line.

    The line is the last one that is not of rsltrace, Python or a library; else ``where``.
    """
    if isinstance(error, JobError):
        return error if error.where else JobError(str(error), where=where)
    if isinstance(error, SyntaxError) and error.filename and error.lineno:
        return JobError(
            f"SyntaxError: {error.msg}", where=f"{shown(error.filename)}:{error.lineno}"
        )
    step = error.__traceback__
    while step is not None:
        file = step.tb_frame.f_code.co_filename
        if ".launch" in file or file.endswith("_launch.py"):
            where = f"{shown(file)}:{step.tb_lineno}"
        step = step.tb_next
    try:
        said = str(error)
    except Exception:
        said = "(its text could not be made)"
    if isinstance(error, (SubstitutionFailure, ValueError)) and said:
        return JobError(said, where=where)
    name = type(error).__name__
    said = _missing_file(error) or (f"{name}: {said}" if said else name)
    return JobError(said, where=where)
