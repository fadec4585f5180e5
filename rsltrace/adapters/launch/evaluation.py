"""The attributes of a launch file's elements as values, with substitutions replaced.

What is found on the way (nodes, and what cannot be simulated) is kept in ``launched``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.model import (
    Attribute,
    Element,
    Launched,
    LaunchScope,
    UnsupportedItem,
    typed,
)
from rsltrace.adapters.launch.substitution import Substitutions, truth
from rsltrace.job.reading.yaml_source import Place


class Evaluation:
    """Evaluates attributes in the scope of the innermost group of the file being read.

    ``delay_ns`` is when what is being read happens, after the launch file has been started; or
    after the node with a ``number`` has ``started`` or ``ended``, if there is an ``after``.
    ``kept`` keeps alive what the numbers are those of.
    """

    def __init__(self, arguments: dict[str, str]) -> None:
        self.launched = Launched()
        self.scope = LaunchScope(configurations=arguments)
        self.delay_ns = 0
        self.after: tuple[str, int] | None = None
        self.kept: list[object] = []
        self._environment = dict(self.scope.environment)
        self._substitutions = Substitutions(self.scope, Path())

    @property
    def file(self) -> Path:
        """The launch file being read."""
        return self._substitutions.file

    @contextmanager
    def within(
        self, *, scope: LaunchScope | None = None, file: Path | None = None
    ) -> Iterator[None]:
        """Evaluate what is read meanwhile in another scope, or for another file."""
        substitutions = self._substitutions
        outer = self.scope, substitutions.file
        self.scope = substitutions.scope = scope or self.scope
        substitutions.file = file or substitutions.file
        try:
            yield
        finally:
            self.scope, substitutions.file = outer
            substitutions.scope = self.scope

    def text(self, attribute: Attribute) -> str:
        """Return an attribute as text. Raises ``JobError`` at its place."""
        value = attribute.value
        if isinstance(value, bool):
            value = str(value).lower()
        return self.replaced(str(value), attribute.place)

    def anonymous(self, name: str) -> str:
        """Return a name that begins with ``name`` and that nobody else has."""
        return self._substitutions.anonymous(name)

    def first_environment(self) -> dict[str, str]:
        """Return the environment that the launch file found."""
        return dict(self._environment)

    def changed_environment(self) -> dict[str, str]:
        """Return what the launch file has set in the environment that it found."""
        return {
            name: value
            for name, value in self.scope.environment.items()
            if self._environment.get(name) != value
        }

    def replaced_text(self, written: str) -> str:
        """Return a text with its substitutions replaced. Raises ``ValueError``."""
        return self._substitutions.text(written)

    def optional(self, element: Element, name: str) -> str | None:
        """Return an attribute as text, or None if it is not given."""
        attribute = element.get(name)
        return None if attribute is None else self.text(attribute)

    def needed(self, element: Element, name: str) -> str:
        """Return an attribute as text. Raises ``JobError`` if it is missing."""
        return self.text(element.need(name))

    def replaced(self, written: str, place: Place) -> str:
        """Return a text with its substitutions replaced."""
        try:
            return self._substitutions.text(written)
        except ValueError as error:
            raise place.error(str(error)) from None

    def value(self, attribute: Attribute, kind: str | None) -> Any:
        """Return an attribute as the value of a parameter."""
        value = attribute.value
        if isinstance(value, list):
            value = [
                self.replaced(item, attribute.place) if isinstance(item, str) else item
                for item in value
            ]
            if kind is None and all(isinstance(item, str) for item in value):
                found = [typed(item, None) for item in value]
                value = found if len({type(item) for item in found}) == 1 else value
        elif isinstance(value, str):
            value = self.replaced(value, attribute.place)
        try:
            return typed(value, kind)
        except ValueError as error:
            raise attribute.place.error(str(error)) from None

    def flag(self, attribute: Attribute | None, default: bool) -> bool:
        """Return an attribute that is true or false."""
        if attribute is None:
            return default
        try:
            return truth(self.text(attribute))
        except ValueError as error:
            raise attribute.place.error(str(error)) from None

    def holds(self, element: Element) -> bool:
        """Return whether an element's conditions hold."""
        yes, no = element.get("if"), element.get("unless")
        if yes is not None and no is not None:
            raise no.place.error("give either 'if' or 'unless', not both")
        return self.flag(yes, True) and not self.flag(no, False)

    def refuse(self, element: Element, what: str, why: str) -> None:
        """Note that something cannot be simulated."""
        where = element.place.source.where(element.place.mark)
        self.launched.unsupported.append(UnsupportedItem(where, what, why))

    def existing_file(self, attribute: Attribute) -> str:
        """Return the path of a file that must be there; relative to the launch file's folder."""
        path = self.file.parent / self.text(attribute)
        if not path.is_file():
            raise attribute.place.error(f"there is no such file: {path}")
        return str(path)
