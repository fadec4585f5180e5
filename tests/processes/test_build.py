"""The library is built from its sources without a warning."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes import build
from rsltrace.errors import SetupError

pytestmark = [pytest.mark.ros, pytest.mark.long]


def _building_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make_here(kind: str, name: str, make: Callable[[Path], None]) -> Path:
        make(folder)
        return folder

    monkeypatch.setattr(build, "cached_folder", make_here)


@pytest.mark.parametrize("sources", [(), build.OBSERVER], ids=["simulated", "native"])
def test_the_library_is_built_without_a_warning(
    sources: tuple[Path, ...], compiled: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _building_in(tmp_path, monkeypatch)
    said: list[str] = []
    built = build.library(said.append, ["-Wall", "-Wextra", "-Werror"], sources)
    assert built.path.exists()
    assert len(said) == 1


def test_what_the_compiler_refuses_is_shown(
    compiled: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _building_in(tmp_path, monkeypatch)
    with pytest.raises(SetupError, match=r"cannot build .*headers of rmw(.|\n)*no-such-header.h"):
        build.library(lambda text: None, ["-include", "no-such-header.h"])
