"""``make dist``: builds wheel and sdist, and tries both where there is nothing else.

    python tests/packaging/check_dist.py FOLDER

The wheel goes into an environment without ROS, where traces are read and compared; the sdist into
one with the wheels of ROS 2, where a job is recorded. Packages come from the index pip knows.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "sample_traces" / "nondeterministic_callback"
JOB = ROOT / "examples" / "rslcpp_determinism"
_CLEAN = ("PYTHONPATH", "AMENT_PREFIX_PATH", "VIRTUAL_ENV", "PYTHONHOME")


class Failed(Exception):
    """Something is not as it should be."""


def run(*command: str | Path, cwd: Path, status: int = 0) -> str:
    """Return what a command printed. Raises Failed for another exit status."""
    environment = {name: value for name, value in os.environ.items() if name not in _CLEAN}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=1500,
    )
    if done.returncode != status:
        shown = " ".join(map(str, command))
        raise Failed(f"{shown}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def build(folder: Path) -> tuple[Path, Path]:
    """Return the wheel and the sdist, which it is made of, in a folder that has nothing else."""
    for old in (*folder.glob("rsltrace-*.whl"), *folder.glob("rsltrace-*.tar.gz")):
        old.unlink()
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    (wheel,), (sdist,) = folder.glob("rsltrace-*.whl"), folder.glob("rsltrace-*.tar.gz")
    return wheel, sdist


def check_contents(wheel: Path, sdist: Path) -> str:
    """Check that all is in them that git knows; return the version."""
    version = wheel.name.split("-")[1]
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        assert len(names) == len(set(names)), "a file is in the wheel twice"
        said = archive.read("rsltrace/_version.py").decode()
    assert repr(version) in said, f"the wheel is {version}, its code says {said}"
    is_compiled = "rsltrace/_core.abi3.so" in names
    assert is_compiled != wheel.name.endswith("-py3-none-any.whl"), wheel.name
    code = {path.relative_to(ROOT) for path in (ROOT / "rsltrace").rglob("*") if path.is_file()}
    sources = {path.relative_to(ROOT) for path in (ROOT / "rsltrace").glob("*.[ch]")}
    code -= {*sources, Path("rsltrace/_core.abi3.so")}
    missing = {str(p) for p in code if "__pycache__" not in p.parts} - set(names)
    assert not missing, f"not in the wheel: {sorted(missing)}"
    assert sum(".data/data/share/man/man1/" in name for name in names) > 10, "no manual pages"
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {
        *map(str, sources),
        "tests/packaging/check_dist.py",
        "docs/install.md",
        "package.xml",
        "man/rsltrace.1",
    }
    assert wanted <= inside, f"not in the sdist: {sorted(wanted - inside)}"
    return version


def environment(folder: Path, what: str) -> Path:
    """Return the programs of a new environment in which ``what`` is installed."""
    venv.create(folder, with_pip=True)
    programs = folder / "bin"
    run(programs / "python", "-m", "pip", "install", "--quiet", what, cwd=folder.parent)
    return programs


def check_without_ros(programs: Path, version: str, folder: Path) -> None:
    """Read and compare traces; recording says what is missing."""
    rsltrace = programs / "rsltrace"
    a, b = SAMPLES / "a.mcap", SAMPLES / "b.mcap"
    run(programs / "python", "-c", "import rclpy", cwd=folder, status=1)
    assert run(rsltrace, "--version", cwd=folder) == f"rsltrace {version}\n"
    assert "482705036bcc1106" in run(rsltrace, "info", a, cwd=folder)
    assert "same-input-different-output" in run(rsltrace, "diff", a, b, cwd=folder, status=1)
    assert "/obstacle_filter" in run(rsltrace, "cat", a, cwd=folder)
    code = f"import rsltrace_viewer.terminal, rsltrace; rsltrace.Trace.open({str(a)!r}).check()"
    run(programs / "python", "-c", code, cwd=folder)
    shutil.copytree(JOB, folder / "job")
    said = run(rsltrace, "record", folder / "job" / "job.yaml", cwd=folder, status=2)
    assert "rsltrace[ros]" in said, said
    assert (programs.parent / "share" / "man" / "man1" / "rsltrace-diff.1").is_file()


def check_with_ros(programs: Path, version: str, folder: Path) -> None:
    """Record the sample job twice: the same, byte for byte."""
    rsltrace, (one, two) = programs / "rsltrace", (folder / "one.mcap", folder / "two.mcap")
    for trace in (one, two):
        run(rsltrace, "record", JOB / "job.yaml", "-o", trace, "--quiet", cwd=folder)
    assert one.read_bytes() == two.read_bytes(), "two runs differ"
    assert "identical" in run(rsltrace, "diff", one, two, cwd=folder)
    assert f"rsltrace {version}" in run(rsltrace, "info", one, cwd=folder)


def main(folder: Path) -> None:
    """Build, check, and say what was made."""
    folder.mkdir(parents=True, exist_ok=True)
    wheel, sdist = build(folder.resolve())
    version = check_contents(wheel, sdist)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        check_without_ros(environment(place / "plain", f"{wheel}[view]"), version, place)
        check_with_ros(environment(place / "ros", f"{sdist}[ros]"), version, place)
    for made in (wheel, sdist):
        print(f"{made.relative_to(Path.cwd()) if made.is_relative_to(Path.cwd()) else made}")
    print("both installed into empty environments: without ROS they read and compare traces,")
    print("with the wheels of ROS 2 they record, twice the same")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "dist")
    except Failed as error:
        sys.exit(f"make dist: {error}")
