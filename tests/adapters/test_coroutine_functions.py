"""The short way to tell a coroutine function from others agrees with Python's own."""

from __future__ import annotations

import functools
import inspect
import sys
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest

from rsltrace.adapters.rclpy.concurrency.tasks import is_coroutine_function


def plain() -> None: ...


async def coroutine() -> None: ...


async def generator() -> Any:
    yield 1


class Things:
    def plain(self) -> None: ...

    async def coroutine(self) -> None: ...

    @staticmethod
    async def static() -> None: ...

    @classmethod
    async def of_class(cls) -> None: ...

    async def __call__(self) -> None: ...

    nested = functools.partialmethod(coroutine)


@functools.wraps(plain)
async def wraps_plain() -> None: ...


@functools.wraps(coroutine)
def wraps_coroutine() -> None: ...


def marked() -> None: ...


if sys.version_info >= (3, 12):
    inspect.markcoroutinefunction(marked)

CALLBACKS = [
    plain,
    coroutine,
    generator,
    lambda: None,
    Things,
    Things(),
    Things().plain,
    Things().coroutine,
    Things.coroutine,
    Things().static,
    Things().of_class,
    Things().nested,
    functools.partial(plain),
    functools.partial(coroutine),
    functools.partial(Things().coroutine),
    wraps_plain,
    wraps_coroutine,
    marked,
    print,
    [].append,
    Mock(),
    AsyncMock(),
    None,
]


@pytest.mark.parametrize("callback", CALLBACKS, ids=lambda callback: type(callback).__name__)
def test_it_is_what_inspect_says(callback: Any) -> None:
    assert is_coroutine_function(callback) is inspect.iscoroutinefunction(callback)


def test_the_examples_are_of_both_kinds() -> None:
    answers = [is_coroutine_function(callback) for callback in CALLBACKS]
    assert answers.count(True) >= 8
    assert answers.count(False) >= 8
