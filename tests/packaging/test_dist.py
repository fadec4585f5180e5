"""What is built has all of rsltrace, and the version of its tag; ``make dist`` tries it."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from rsltrace._version import __version__
from tests.packaging import check_dist

ROOT = Path(__file__).resolve().parents[2]


def test_a_checkout_has_one_version() -> None:
    assert ElementTree.parse(ROOT / "package.xml").findtext("version") == __version__
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)


@pytest.mark.long
@pytest.mark.parametrize("compiler", ["cc", "false"])
def test_wheel_and_sdist_have_all_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiler: str
) -> None:
    pytest.importorskip("hatch_vcs")
    monkeypatch.setenv("CC", compiler)
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path, ROOT]
    check_dist.run(*build, cwd=tmp_path)
    (wheel,), (sdist,) = tmp_path.glob("*.whl"), tmp_path.glob("*.tar.gz")
    version = check_dist.check_contents(wheel, sdist)
    can_compile = compiler == "cc" and shutil.which("cc") is not None
    assert wheel.name.endswith("-py3-none-any.whl") != can_compile
    assert sdist.name == f"rsltrace-{version}.tar.gz"


@pytest.mark.long
def test_the_version_is_that_of_the_tag(tmp_path: Path) -> None:
    pytest.importorskip("hatch_vcs")
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)

    def version() -> str:
        return check_dist.run(sys.executable, "-m", "hatchling", "version", cwd=tmp_path).strip()

    def git(*words: str) -> None:
        own = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main")
        subprocess.run(["git", *own, *words], cwd=tmp_path, check=True, capture_output=True)

    assert version() == "0.1.dev0"  # no repository, as in an archive of the sources
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    assert version().startswith("0.1.dev1+g")
    git("tag", "v0.3.0")
    git("tag", "unrelated-7")
    assert version() == "0.3.0"
    git("commit", "--allow-empty", "-m", "second")
    assert version().startswith("0.3.1.dev1+g")
