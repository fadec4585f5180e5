"""``guard:`` — what is done about each source of nondeterminism, for a job or for one node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.checks import Check, attach, check, flag, items, text
from rsltrace.job.values.problem import JobProblem, as_flag, describe
from rsltrace.trace.model.finding import (
    DEFAULT_MODES,
    MODES,
    GuardMode,
    GuardPolicy,
    NondeterminismSource,
)

ModeName = Literal["virtual", "record", "warn", "error", "allow"]


def _module_glob(value: str) -> None:
    if not value.replace("*", "a").replace("?", "a").replace(".", "a").isidentifier():
        raise JobProblem(f"expected the name of a module, or a glob like my_robot.*, got {value!r}")


class SourceSpec(JobPart):
    """How one source is handled."""

    mode: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="`virtual`: simulated; `record`: real, and kept in the trace; `warn`: a "
        "finding; `error`: ends the run; `allow`: nothing.",
        examples=["warn"],
    )
    allow: Annotated[tuple[str, ...], check(items(text(_module_glob)))] = Field(
        default=(),
        description="Modules that may use the source, as globs.",
        examples=[["my_robot.logging", "rerun.*"]],
    )

    if TYPE_CHECKING:

        def __init__(self, *, mode: ModeName | None = None, allow: Sequence[str] = ()) -> None: ...


def _source(source: NondeterminismSource) -> Check:
    """Prepare one source: its mode as plain text, or a mapping with its mode and exemptions."""
    valid = [mode.value for mode in MODES[source]]

    def mode_alone(value: object) -> object:
        given = value.get("mode") if isinstance(value, dict) else getattr(value, "mode", value)
        if given is not None and given not in valid:
            hint = ""
            if given in list(GuardMode):
                hint = f"; the answers of this source cannot be made {given!r}"
                if given == GuardMode.RECORD:
                    hint = "; what this source answers cannot be recorded"
            place = ("mode",) if isinstance(value, dict) else ()
            raise JobProblem(
                f"expected one of {', '.join(valid)}, got {describe(given)}{hint}", place
            )
        return {"mode": value} if isinstance(value, str) else value

    mode = {"enum": valid}
    allow = {"type": "array", "items": {"type": "string"}}
    whole = {
        "type": "object",
        "properties": {"mode": mode, "allow": allow},
        "additionalProperties": False,
    }
    attach(mode_alone, schema={"anyOf": [mode, whole]})
    return check(mode_alone, optional=True)


def _about(source: NondeterminismSource, what: str) -> Any:
    default = DEFAULT_MODES[source].value
    return Field(
        default=None,
        description=f"{what} Default: `{default}`.",
        examples=[MODES[source][0].value],
    )


def _state(value: object) -> object:
    if value is True or value is False or value == "record":
        return value
    raise JobProblem(f"expected true, false or record, got {describe(value)}")


attach(_state, schema={"enum": [True, False, "record"]})


class GuardSpec(JobPart):
    """``guard:`` of a job, or of a node, which overrides the job's keys.

    ``enabled`` false (``guard: false``) leaves everything as it is. ``state`` hashes a node's state
    after each callback; ``record`` keeps its attributes, too. A source that is None keeps what the
    job says, or the default.
    """

    enabled: Annotated[bool, check(flag)] = Field(
        default=True,
        description="`false` allows every source.",
        examples=[False],
    )
    pin: Annotated[bool | None, check(flag, optional=True)] = Field(
        default=None,
        description="Whether `rsltrace record` pins its process: hash seed, addresses, time"
        " zone, locale, threads. Only for the job. Default: `true`.",
        examples=[False],
    )
    state: Annotated[bool | Literal["record"] | None, check(_state, optional=True)] = Field(
        default=None,
        description="Whether node states are hashed after each event; `record` also keeps them.",
        examples=[True, "record"],
    )
    clock: Annotated[SourceSpec | None, _source(NondeterminismSource.CLOCK)] = _about(
        NondeterminismSource.CLOCK, "Wall clocks: `time.time`, `datetime.now` and the like."
    )
    random: Annotated[SourceSpec | None, _source(NondeterminismSource.RANDOM)] = _about(
        NondeterminismSource.RANDOM,
        "Random numbers: `random`, `numpy.random`, `os.urandom`, `uuid4`, `secrets`.",
    )
    directory: Annotated[SourceSpec | None, _source(NondeterminismSource.DIRECTORY)] = _about(
        NondeterminismSource.DIRECTORY, "The order of directory listings."
    )
    file: Annotated[SourceSpec | None, _source(NondeterminismSource.FILE)] = _about(
        NondeterminismSource.FILE, "What files hold."
    )
    environment: Annotated[SourceSpec | None, _source(NondeterminismSource.ENVIRONMENT)] = _about(
        NondeterminismSource.ENVIRONMENT, "Environment variables."
    )
    pid: Annotated[SourceSpec | None, _source(NondeterminismSource.PID)] = _about(
        NondeterminismSource.PID,
        "The process id (`os.getpid`): by default each main has a number of its own.",
    )
    thread: Annotated[SourceSpec | None, _source(NondeterminismSource.THREAD)] = _about(
        NondeterminismSource.THREAD, "Threads that are started."
    )
    process: Annotated[SourceSpec | None, _source(NondeterminismSource.PROCESS)] = _about(
        NondeterminismSource.PROCESS, "Processes that are started."
    )
    socket: Annotated[SourceSpec | None, _source(NondeterminismSource.SOCKET)] = _about(
        NondeterminismSource.SOCKET, "Sockets."
    )
    address: Annotated[SourceSpec | None, _source(NondeterminismSource.ADDRESS)] = _about(
        NondeterminismSource.ADDRESS, "Addresses of objects: `id`, the default `hash` and `repr`."
    )
    order: Annotated[SourceSpec | None, _source(NondeterminismSource.ORDER)] = _about(
        NondeterminismSource.ORDER, "The order of sets, which depends on hash seeds."
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            enabled: bool = True,
            pin: bool | None = None,
            state: bool | Literal["record"] | None = None,
            clock: SourceSpec | dict[str, Any] | ModeName | None = None,
            random: SourceSpec | dict[str, Any] | ModeName | None = None,
            directory: SourceSpec | dict[str, Any] | ModeName | None = None,
            file: SourceSpec | dict[str, Any] | ModeName | None = None,
            environment: SourceSpec | dict[str, Any] | ModeName | None = None,
            pid: SourceSpec | dict[str, Any] | ModeName | None = None,
            thread: SourceSpec | dict[str, Any] | ModeName | None = None,
            process: SourceSpec | dict[str, Any] | ModeName | None = None,
            socket: SourceSpec | dict[str, Any] | ModeName | None = None,
            address: SourceSpec | dict[str, Any] | ModeName | None = None,
            order: SourceSpec | dict[str, Any] | ModeName | None = None,
        ) -> None: ...

    @property
    def pins(self) -> bool:
        """Whether the process that records the job is pinned."""
        return self.enabled and self.pin is not False


def _guard(value: object) -> object:
    """Let true and false stand for ``{enabled: …}``."""
    if isinstance(value, str):
        hint = as_flag(value)
        raise JobProblem(f"expected true, false or a mapping, got {describe(value)}{hint}")
    return {"enabled": value} if isinstance(value, bool) else value


guard_part = check(_guard, optional=True, shorthand="enabled")


def resolved_guard(*guards: GuardSpec) -> dict[str, Any]:
    """Return what ``policy_of`` says, as JSON-compatible values."""
    policy = policy_of(*guards)
    values: dict[str, Any] = {
        source.value: {"mode": mode.value, "allow": list(policy.allowed.get(source, ()))}
        for source, mode in policy.modes.items()
    }
    return {
        "enabled": guards[0].enabled,
        "pin": guards[0].pins,
        "state": policy.state or "false",
        **values,
    }


def policy_of(*guards: GuardSpec) -> GuardPolicy:
    """Return what is done in the end, where a later ``guard:`` overrides an earlier one."""
    modes = dict(DEFAULT_MODES)
    allowed: dict[NondeterminismSource, tuple[str, ...]] = {}
    state = ""
    for guard in guards:
        if not guard.enabled:
            modes = dict.fromkeys(NondeterminismSource, GuardMode.ALLOW)
        if guard.state is not None:
            state = "record" if guard.state == "record" else "true" if guard.state else ""
        for source in NondeterminismSource:
            spec: SourceSpec | None = getattr(guard, source.value)
            if spec is not None:
                if spec.mode is not None:
                    modes[source] = GuardMode(spec.mode)
                allowed[source] = allowed.get(source, ()) + spec.allow
    return GuardPolicy(modes, allowed, state)
