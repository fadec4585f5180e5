"""The checkout is a package of a ROS 2 workspace: colcon builds it, and ``ros2`` finds it there."""

from __future__ import annotations

import json
import subprocess
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COLCON = ("colcon-core", "colcon-ros", "colcon-python-setup-py", "colcon-recursive-crawl")
COLCON += ("colcon-bash", "colcon-library-path", "setuptools==68.1.2")  # Ubuntu 24.04's
_PROBE = """
import json, rsltrace, rsltrace_viewer
from importlib.metadata import entry_points
(entry,) = {e.value: e for e in entry_points(group="ros2cli.command")}.values()
print(json.dumps([rsltrace.__file__, rsltrace_viewer.__file__, entry.value]))
"""


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with colcon, in which rsltrace's dependencies are found, but not rsltrace."""
    folder = tmp_path_factory.mktemp("colcon")
    venv.create(folder, with_pip=True)
    pip = [folder / "bin" / "python", "-m", "pip", "install", "--quiet", *COLCON]
    if subprocess.run(pip, timeout=900, capture_output=True).returncode:
        pytest.skip("colcon cannot be installed from here")
    (library,) = folder.glob("lib/python*/site-packages")
    (library / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    return folder / "bin"


def sourced(workspace: Path, programs: Path, command: str) -> str:
    environment = {"PATH": f"{programs}:/usr/bin:/bin", "HOME": str(workspace)}
    done = subprocess.run(
        ["bash", "-c", f". install/local_setup.bash && {command}"],
        cwd=workspace,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.long
@pytest.mark.parametrize("how", [(), ("--symlink-install",)], ids=["copied", "linked"])
def test_colcon_builds_the_checkout(tmp_path: Path, programs: Path, how: tuple[str, ...]) -> None:
    source = tmp_path / "src" / "rsltrace"
    source.mkdir(parents=True)
    for name in ("package.xml", "pyproject.toml", "setup.py", "resource", "man", "rsltrace"):
        (source / name).symlink_to(ROOT / name)
    (source / "viewer").symlink_to(ROOT / "viewer")
    environment = {"PATH": f"{programs}:/usr/bin:/bin", "HOME": str(tmp_path)}
    build = [programs / "colcon", "build", *how]
    done = subprocess.run(
        build,
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert sourced(tmp_path, programs, "command -v rsltrace").startswith(str(tmp_path / "install"))
    assert "Commands:" in sourced(tmp_path, programs, "rsltrace --help")
    probe = sourced(tmp_path, programs, f"{programs / 'python'} -c '{_PROBE}'")
    code, viewer, entry = json.loads(probe)
    assert entry == "rsltrace.cli.ros2:RsltraceCommand"
    for file in (code, viewer):
        assert file.startswith(str(tmp_path))
    sample = ROOT / "sample_traces" / "schedule" / "a.mcap"
    assert "fd6686be63784a17" in sourced(tmp_path, programs, f"rsltrace info '{sample}'")
    share = tmp_path / "install" / "rsltrace" / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "rsltrace").exists()
    assert (share / "man" / "man1" / "rsltrace-diff.1").exists()
    if not how:
        installed = Path(code).parent
        assert _files(installed) == _files(ROOT / "rsltrace")


def _files(folder: Path) -> set[str]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)) for path in found if path.suffix != ".pyc"}
