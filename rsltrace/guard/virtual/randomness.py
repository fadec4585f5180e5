"""Random numbers from seeds: every node draws from its own streams.

The module functions of ``random`` and numpy share one generator per process; here each node has its
own, so adding a node does not change the others. Everything else that needs entropy (``Random()``,
``secrets``, ``uuid4``, ``default_rng()``) gets it through ``os.urandom`` or ``Random.seed``, and so
from the node's stream, too.
"""

from __future__ import annotations

import _random
import os
import random
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from sys import _getframe
from types import BuiltinFunctionType, FrameType, FunctionType, MethodType
from typing import Any

from rsltrace.guard import frames
from rsltrace.guard.callers import FILE_OWNERS, OURS
from rsltrace.guard.frames import caller, code_of
from rsltrace.guard.guard import Guard, engaged
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.redirect import (
    Redirected,
    RedirectedMethod,
    RedirectedReader,
    copy_of,
    has_no_arguments,
    redirect,
    replace_attribute,
)
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_RANDOM = NondeterminismSource.RANDOM
_NUMPY = "numpy.random"
_NODE_ID = 0x02_00_00_00_00_01
"""A locally administered MAC address, for ``uuid1`` and ``getnode``."""


_real_entropy = copy_of(os.urandom)


_Virtual = Callable[[Guard, str], Callable[..., Any]]
"""Returns the function that draws from the stream of that name."""


def _drawing(
    call: str, real: Callable[..., Any], virtual: _Virtual, *, is_method: bool = False
) -> Any:
    """Return the replacement of a random function; of a method the object is dropped."""

    def draw(*arguments: Any, **options: Any) -> Any:
        if is_method:
            arguments = arguments[1:]
        guard = engaged()
        if guard is None:
            return real(*arguments, **options)
        try:
            frame = frames.next_caller()
        except frames.INTERRUPTED:
            frame = frames.lost_caller()
        if guard.answers_random:
            kind = FILE_OWNERS[code_of(frame).co_filename]
            drawing = guard.known_random_function(call, kind) if kind <= OURS else None
            return (drawing or guard.random_function(call, virtual, frame))(*arguments, **options)
        return _answer(guard, frame, call, virtual, partial(real, *arguments, **options))

    return draw


def _drawing_without_arguments(
    call: str, real: Callable[[], Any], virtual: _Virtual
) -> Callable[[dict[str, Any]], Any]:
    """Return the replacement of a function without arguments, for ``RedirectedReader``."""

    def draw(names: dict[str, Any]) -> Any:
        guard = engaged()
        if guard is None:
            return real()
        frame = None
        try:
            kind = guard.kinds[names["__file__"]]
        except (KeyError, TypeError):
            frame = caller()
            kind = guard.file_kind(names, frame)
        if guard.answers_random:
            drawing = guard.known_random_function(call, kind) if kind <= OURS else None
            return (drawing or guard.random_function(call, virtual, frame or caller()))()
        return _answer(guard, frame or caller(), call, virtual, partial(real))

    return draw


def _answer(
    guard: Guard, frame: FrameType, call: str, virtual: _Virtual, real: partial[Any]
) -> Any:
    """Draw as the job says."""
    mode = guard.mode(_RANDOM, frame)
    if mode is GuardMode.VIRTUAL:
        return guard.random_function(call, virtual, frame)(*real.args, **real.keywords)
    if mode is GuardMode.RECORD:
        stream = guard.stream(frame)
        guard.streams.begin(
            stream,
            lambda: guard.record(_RANDOM, "entropy", lambda: _real_entropy(32).hex(), frame),
        )
        return virtual(guard, stream)(*real.args, **real.keywords)
    value = real()
    if mode is not GuardMode.ALLOW:
        guard.report(_RANDOM, mode, call, value, frame, _shown)
    return value


def _shown(value: object) -> str:
    text = value.hex() if isinstance(value, bytes) else repr(value)
    return text if len(text) <= 200 else text[:199] + "…"


@contextmanager
def virtual_randomness() -> Iterator[None]:
    """Redirect all random functions."""
    with ExitStack() as stack:
        _module_functions(stack, random, random._inst, "random", _random_of)
        replace_attribute(stack, random, "_inst", _SharedGenerator())
        _entropy(stack)
        _unseeded(stack)
        _uuids(stack)
        when_loaded(stack, _NUMPY, partial(_numpy_functions, stack))
        yield


def _numpy_functions(stack: ExitStack) -> None:
    module: Any = sys.modules[_NUMPY]
    _module_functions(stack, module, module.mtrand._rand, _NUMPY, _numpy_of)
    _shared_numpy(stack, module)


class _SharedGenerator(random.Random):
    """What libraries (networkx) use as the generator behind ``random``'s functions."""

    def __init__(self) -> None:
        """Do not seed: that would seed the module."""

    def __getattribute__(self, name: str) -> Any:
        """Return the module's function of that name, which finds the caller's stream."""
        if name.startswith("_"):
            return super().__getattribute__(name)
        return vars(random).get(name) or super().__getattribute__(name)


def _random_of(guard: Guard, stream: str) -> Any:
    return guard.streams.random(stream)


def _numpy_of(guard: Guard, stream: str) -> Any:
    return guard.streams.numpy(stream)


def _module_functions(
    stack: ExitStack,
    module: Any,
    owner: Any,
    prefix: str,
    generator: Callable[[Guard, str], Any],
) -> None:
    """Redirect a module's functions that are methods of one shared generator."""
    for name, function in sorted(vars(module).items()):
        if getattr(function, "__self__", None) is not owner or function.__name__ != name:
            continue
        real = getattr(owner, name)  # a new object: only the module's own is redirected

        def virtual(guard: Guard, stream: str, name: str = name) -> Any:
            return getattr(generator(guard, stream), name)

        call = f"{prefix}.{name}()"
        if isinstance(function, MethodType):
            draw = _drawing(call, real, virtual, is_method=True)
            stack.callback(RedirectedMethod(function, draw).restore)
        elif has_no_arguments(function):
            stack.callback(
                RedirectedReader(function, _drawing_without_arguments(call, real, virtual)).restore
            )
        else:
            stack.callback(Redirected(function, _drawing(call, real, virtual)).restore)


def _entropy(stack: ExitStack) -> None:
    def bytes_of(guard: Guard, stream: str) -> Callable[..., bytes]:
        def entropy(size: int = 0, flags: int = 0) -> bytes:
            if not isinstance(size, int) or size < 0:
                raise ValueError("negative argument not allowed")
            return guard.streams.entropy(stream, size)

        return entropy

    for name in ("urandom", "getrandom"):
        function = getattr(os, name, None)
        if isinstance(function, BuiltinFunctionType):
            redirect(stack, function, partial(_drawing, f"os.{name}()", virtual=bytes_of))


def _unseeded(stack: ExitStack) -> None:
    """``Random()`` without a seed takes entropy in C, past redirected functions."""
    real = random.Random.seed

    def seed(self: random.Random, a: Any = None, version: int = 2) -> None:
        if a is None and not isinstance(self, random.SystemRandom):
            guard = engaged()
            if guard is not None:
                a = int.from_bytes(os.urandom(32), "big")
        real(self, a, version)

    replace_attribute(stack, random.Random, "seed", seed)
    replace_attribute(stack, _random, "Random", _Generator)


class _Generator(_random.Random):
    """The generator in C, which takes entropy in C, too, if it gets no seed."""

    def __init__(self, *seed: Any) -> None:
        """Seed, as the type does when it makes a generator or, from Python 3.11 on, here."""
        self.seed(*seed)

    def seed(self, a: Any = None, /) -> None:
        """Seed as ``random.Random`` does without a seed."""
        super().seed(int.from_bytes(os.urandom(32), "big") if a is None else a)


def _uuids(stack: ExitStack) -> None:
    """Replace what ``uuid1`` uses besides ``time`` and ``random``: the machine's address."""
    for name, value in (
        ("_generate_time_safe", None),
        ("_node", _NODE_ID),
        ("_last_timestamp", None),
    ):
        if hasattr(uuid, name):
            replace_attribute(stack, uuid, name, value)
    saved = uuid.uuid1.__code__
    replace_attribute(stack, uuid.uuid1, "__code__", _uuid1_code.__code__)  # wherever it is bound
    _real_uuid1[:] = [FunctionType(saved, vars(uuid), "uuid1", uuid.uuid1.__defaults__)]


_real_uuid1: list[Callable[..., uuid.UUID]] = []


def _uuid1_code(node=None, clock_seq=None):  # type: ignore[no-untyped-def]
    from rsltrace.guard.virtual.randomness import uuid1

    return uuid1(node, clock_seq)


def uuid1(node: int | None, clock_seq: int | None) -> uuid.UUID:
    """Call ``uuid.uuid1``, which never returns a time twice, with a state per node."""
    real, guard = _real_uuid1[0], engaged()
    if guard is None:
        return real(node, clock_seq)
    module: Any = uuid
    last, stream = guard.streams.last_uuid, guard.stream(_getframe(2))
    module._last_timestamp = last.get(stream)
    made = real(node, clock_seq)
    last[stream] = module._last_timestamp
    return made


def _shared_numpy(stack: ExitStack, module: Any) -> None:
    """Restore the state of numpy's shared generator afterwards: scipy.stats uses it directly."""
    shared = module.mtrand._rand
    stack.callback(shared.set_state, shared.get_state())
    real = module.seed  # a function of its own that goes past the redirected methods

    def seeding(guard: Guard, stream: str) -> Callable[..., Any]:
        seed: Callable[..., Any] = _numpy_of(guard, stream).seed
        return seed

    draw = wraps(real)(_drawing("numpy.random.seed()", real, seeding))
    for place in (module, module.mtrand):
        replace_attribute(stack, place, "seed", draw)


def seed_shared_generator(stack: ExitStack, seed: int) -> None:
    """Seed numpy's shared generator, which cannot be divided into streams, for the run of
    ``stack``."""

    def begin() -> None:
        module: Any = sys.modules[_NUMPY]
        module.mtrand._rand.seed(random.Random(f"numpy {seed}").getrandbits(32))

    when_loaded(stack, _NUMPY, begin)
