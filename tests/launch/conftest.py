"""Launch files in a folder of their own, with a Python package that is installed next to them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace.adapters.launch.model import LaunchResult
from rsltrace.adapters.launch.reader import read_launch_file


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An install prefix with package ``demo``: scripts in two languages, a binary, a config."""
    prefix = tmp_path / "install"
    executables = prefix / "lib" / "demo"
    executables.mkdir(parents=True)
    for name in ("talker", "listener"):
        (executables / name).write_text("#!/usr/bin/env python3\n")
    (executables / "compiled").write_bytes(b"\x7fELF\x02\x01\x01" + bytes(64))
    (executables / "script").write_text("#!/bin/sh\n")
    for path in executables.iterdir():
        path.chmod(0o755)
    config = prefix / "share" / "demo" / "config"
    config.mkdir(parents=True)
    (config / "demo.yaml").write_text(
        "/**:\n  ros__parameters: {rate: 3.0, word: from file}\n"
        "/front/camera:\n  ros__parameters: {exposure: {time: 5}}\n"
    )
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "demo").write_text("")
    old = os.environ.get("AMENT_PREFIX_PATH")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{prefix}{os.pathsep + old if old else ''}")
    return prefix


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Write a file below ``tmp_path``, which is the current folder, too."""
    monkeypatch.chdir(tmp_path)

    def go(text: str, name: str = "a.launch.xml") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return go


@pytest.fixture
def read(write: Callable[..., Path]) -> Callable[..., LaunchResult]:
    """Write a launch file and read it with the reader that needs no ROS."""

    def go(text: str, name: str = "a.launch.xml", **arguments: str) -> LaunchResult:
        return read_launch_file(write(text, name), arguments)

    return go
