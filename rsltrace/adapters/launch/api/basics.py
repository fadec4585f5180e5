"""What every launch file is made of: substitutions, conditions, actions, and the context of all."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.evaluation import Evaluation
from rsltrace.adapters.launch.model import Argument, UnsupportedItem
from rsltrace.errors import JobError

_OWN = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))


class SubstitutionFailure(RuntimeError):
    """A substitution cannot be replaced by text."""


class Substitution:
    """Something that becomes text when it is needed."""

    def describe(self) -> str:
        """Return how to call it in a message."""
        return type(self).__name__

    def perform(self, context: LaunchContext) -> str:
        """Return the text."""
        raise NotImplementedError(f"{type(self).__name__} has no perform()")


class TextSubstitution(Substitution):
    """A plain text."""

    def __init__(self, *, text: str) -> None:
        if not isinstance(text, str):
            raise TypeError(f"TextSubstitution takes text, not {type(text).__name__}")
        self.text = text

    def describe(self) -> str:
        """Return the text."""
        return self.text

    def perform(self, context: LaunchContext) -> str:
        """Return the text."""
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
    """What a launch file can see and do while it is read; ``evaluation`` is who keeps it.

    One that a launch file makes for itself sees nothing.
    """

    def __init__(
        self,
        *,
        argv: Sequence[str] | None = None,
        noninteractive: bool = True,
        evaluation: Evaluation | None = None,
    ) -> None:
        self.argv = list(argv or ())
        self.noninteractive = noninteractive
        self.evaluation = Evaluation({}) if evaluation is None else evaluation
        self.later: list[Callable[[], None]] = []
        """What happens once the launch file has been read: event handlers."""
        self.include: Callable[[Path], None] | None = None
        self.where = ""
        """Where the action is that is being done."""

    @property
    def launch_configurations(self) -> dict[str, str]:
        """The launch arguments, as text."""
        return self.evaluation.scope.configurations

    @property
    def environment(self) -> dict[str, str]:
        """The environment that processes would get."""
        return self.evaluation.scope.environment

    def perform_substitution(self, substitution: Substitution) -> str:
        """Return what a substitution stands for."""
        return substitution.perform(self)

    def text(self, given: Any) -> str:
        """Return what text or substitutions stand for."""
        return perform_substitutions(self, as_substitutions(given))

    def optional(self, given: Any) -> str | None:
        """Return what text or substitutions stand for, None for None."""
        return None if given is None else self.text(given)

    def refuse(self, where: str, what: str, why: str) -> None:
        """Note that something cannot be simulated."""
        self.evaluation.launched.unsupported.append(UnsupportedItem(where, what, why))


class Condition:
    """Whether an action is done; ``predicate`` is asked."""

    def __init__(self, *, predicate: Callable[[LaunchContext], bool] | None = None) -> None:
        self._predicate_func = predicate

    def evaluate(self, context: LaunchContext) -> bool:
        """Return whether it holds."""
        return True if self._predicate_func is None else bool(self._predicate_func(context))


class LaunchDescriptionEntity:
    """Anything that a launch description holds."""

    def visit(self, context: LaunchContext) -> None:
        """Do it, and what it brings."""
        raise NotImplementedError(f"{type(self).__name__} has no visit()")

    def inside(self) -> Iterable[Any]:
        """Give what is known to be in it before it is visited."""
        return ()


class Action(LaunchDescriptionEntity):
    """Something to do, if its condition holds. ``where`` is where the launch file makes it."""

    def __init__(self, *, condition: Condition | None = None) -> None:
        self._condition = condition

    def __new__(cls, *_: Any, **__: Any) -> Action:
        """Note where it is made: subclasses of others may never call ``Action.__init__``."""
        action = super().__new__(cls)
        action.where = calling_line()
        action._condition = None
        return action

    where: str
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
            raise as_job_error(error, self.where) from error
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
        """Give its entities."""
        return self.entities

    def visit(self, context: LaunchContext) -> None:
        """Do all of them; what they declare is known from the beginning."""
        note_arguments(context, self)
        visit_all(context, self.entities)


def visit_all(context: LaunchContext, entities: Any) -> None:
    """Do the entities of a sequence."""
    for entity in entities:
        if not isinstance(entity, LaunchDescriptionEntity):
            raise TypeError(
                f"a launch description holds actions, and here is {type(entity).__name__}: "
                f"{entity!r:.80}"
            )
        entity.visit(context)


def note_arguments(context: LaunchContext, entity: LaunchDescriptionEntity) -> None:
    """Note what an entity declares, and what is in it does."""
    declared: Argument | None = getattr(entity, "argument", None)
    if declared is not None:
        context.evaluation.launched.arguments.setdefault(declared.name, declared)
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
    return JobError(f"{name}: {said}" if said else name, where=where)


__all__ = [
    "Action",
    "Condition",
    "LaunchContext",
    "LaunchDescription",
    "LaunchDescriptionEntity",
    "Substitution",
    "SubstitutionFailure",
    "TextSubstitution",
    "as_job_error",
    "as_substitutions",
    "calling_line",
    "perform_substitutions",
    "shown",
    "visit_all",
]
