"""``guard:`` — what is done about each source of nondeterminism, for a job or for one node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, ValidationInfo

from rsltrace.job.part import Part, check, flag, from_file, items, text
from rsltrace.job.problems import Problem, describe
from rsltrace.model.finding import DEFAULT_MODES, MODES, Mode, Policy, Source

ModeName = Literal["virtual", "record", "warn", "error", "allow"]


def _module_glob(value: str) -> None:
    if not value.replace("*", "a").replace("?", "a").replace(".", "a").isidentifier():
        raise Problem(f"expected the name of a module, or a glob like my_robot.*, got {value!r}")


class SourceSpec(Part):
    """What is done about one source, and the modules (globs) that may use it all the same."""

    mode: Annotated[str | None, check(text(), optional=True)] = None
    allow: Annotated[tuple[str, ...], check(items(text(_module_glob)))] = ()

    if TYPE_CHECKING:

        def __init__(self, *, mode: ModeName | None = None, allow: Sequence[str] = ()) -> None: ...


def _source(source: Source) -> BeforeValidator:
    """Prepare one source: its mode as plain text, or a mapping with its mode and exemptions."""
    valid = [mode.value for mode in MODES[source]]

    def validate(value: object, info: ValidationInfo) -> object:
        if value is None:
            if from_file(info):
                raise Problem("no value is given: give one, or leave the key out")
            return None
        given = value.get("mode") if isinstance(value, dict) else getattr(value, "mode", value)
        if given is not None and given not in valid:
            hint = ""
            if given in list(Mode):
                hint = f"; the answers of this source cannot be made {given!r}"
                if given == Mode.RECORD:
                    hint = "; what this source answers cannot be recorded"
            place = ("mode",) if isinstance(value, dict) else ()
            raise Problem(f"expected one of {', '.join(valid)}, got {describe(given)}{hint}", place)
        return {"mode": value} if isinstance(value, str) else value

    return BeforeValidator(validate)


def _state(value: object) -> object:
    if value is True or value is False or value == "record":
        return value
    raise Problem(f"expected true, false or record, got {describe(value)}")


class GuardSpec(Part):
    """``guard:`` of a job, or of a node, where it overrides the job's key by key.

    ``enabled`` false (``guard: false``) leaves everything as it is. ``state`` hashes a node's state
    after each callback; ``record`` keeps its attributes, too. A source that is None keeps what the
    job says, or the default.
    """

    enabled: Annotated[bool, check(flag)] = True
    state: Annotated[bool | Literal["record"] | None, check(_state, optional=True)] = None
    clock: Annotated[SourceSpec | None, _source(Source.CLOCK)] = None
    random: Annotated[SourceSpec | None, _source(Source.RANDOM)] = None
    directory: Annotated[SourceSpec | None, _source(Source.DIRECTORY)] = None
    file: Annotated[SourceSpec | None, _source(Source.FILE)] = None
    environment: Annotated[SourceSpec | None, _source(Source.ENVIRONMENT)] = None
    thread: Annotated[SourceSpec | None, _source(Source.THREAD)] = None
    process: Annotated[SourceSpec | None, _source(Source.PROCESS)] = None
    socket: Annotated[SourceSpec | None, _source(Source.SOCKET)] = None
    address: Annotated[SourceSpec | None, _source(Source.ADDRESS)] = None
    order: Annotated[SourceSpec | None, _source(Source.ORDER)] = None

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            enabled: bool = True,
            state: bool | Literal["record"] | None = None,
            clock: SourceSpec | dict[str, Any] | ModeName | None = None,
            random: SourceSpec | dict[str, Any] | ModeName | None = None,
            directory: SourceSpec | dict[str, Any] | ModeName | None = None,
            file: SourceSpec | dict[str, Any] | ModeName | None = None,
            environment: SourceSpec | dict[str, Any] | ModeName | None = None,
            thread: SourceSpec | dict[str, Any] | ModeName | None = None,
            process: SourceSpec | dict[str, Any] | ModeName | None = None,
            socket: SourceSpec | dict[str, Any] | ModeName | None = None,
            address: SourceSpec | dict[str, Any] | ModeName | None = None,
            order: SourceSpec | dict[str, Any] | ModeName | None = None,
        ) -> None: ...


def guard_part() -> BeforeValidator:
    """Prepare a ``guard:`` for pydantic; true and false stand for ``{enabled: …}``."""

    def validate(value: object, info: ValidationInfo) -> object:
        if value is None and from_file(info):
            raise Problem("no value is given: give one, or leave the key out")
        return {"enabled": value} if isinstance(value, bool) else value

    return BeforeValidator(validate)


def resolved_guard(*guards: GuardSpec) -> dict[str, Any]:
    """Return what ``policy_of`` says, as JSON-compatible values."""
    policy = policy_of(*guards)
    values: dict[str, Any] = {
        source.value: {"mode": mode.value, "allow": list(policy.allowed.get(source, ()))}
        for source, mode in policy.modes.items()
    }
    return {"enabled": guards[0].enabled, "state": policy.state or "false", **values}


def policy_of(*guards: GuardSpec) -> Policy:
    """Return what is done in the end, where a later ``guard:`` overrides an earlier one."""
    modes = dict(DEFAULT_MODES)
    allowed: dict[Source, tuple[str, ...]] = {}
    state = ""
    for guard in guards:
        if not guard.enabled:
            modes = dict.fromkeys(Source, Mode.ALLOW)
        if guard.state is not None:
            state = "record" if guard.state == "record" else "true" if guard.state else ""
        for source in Source:
            spec: SourceSpec | None = getattr(guard, source.value)
            if spec is not None:
                if spec.mode is not None:
                    modes[source] = Mode(spec.mode)
                allowed[source] = allowed.get(source, ()) + spec.allow
    return Policy(modes, allowed, state)
