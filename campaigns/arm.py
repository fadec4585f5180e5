"""Record the examples on an emulated ARM machine and compare their digests with this one's.

    sudo apt-get install debootstrap qemu-user-static binfmt-support
    sudo make test-arm                       # or: python -m campaigns.arm cart ping_pong/job_burst

A Debian for arm64 is unpacked in ``out/arm`` (nothing of it is installed or started). The aarch64
wheels of rsltrace's dependencies are unpacked into its Python, and ``rsltrace install-ros`` adds
rclpy without ROS's libraries. Each job is then recorded on both. The exit status is 0 if all
digests are equal.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

PROJECT = Path(__file__).parents[1]
ROOT = PROJECT / "out" / "arm"
PYTHON_VERSION = "3.11"  # of the Debian release below
RELEASE = "bookworm"
PACKAGES = Path("usr/lib/python3/dist-packages")
FOLDERS = ("rsltrace", "viewer", "examples", "sample_traces")
GLIBC = range(17, 37)


def main(arguments: Sequence[str] | None = None) -> int:
    """Record the jobs of the command line, or all examples, and print a table of their digests."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("jobs", nargs="*", help="example folders or jobs (default: all examples)")
    parser.add_argument("--new", action="store_true", help="unpack the ARM machine again")
    options = parser.parse_args(arguments)
    missing = [name for name in ("debootstrap", "dpkg-deb", "chroot") if not shutil.which(name)]
    if missing or os.geteuid() != 0:
        print("needs root and: apt-get install debootstrap qemu-user-static binfmt-support")
        return 2
    system = ROOT / "system"
    if options.new or not (system / "complete").exists():
        shutil.rmtree(ROOT, ignore_errors=True)
        _unpack(system)
        (system / "complete").touch()
    _copy_project(system / "project")
    print("| job | x86_64 | aarch64 | equal |\n| --- | --- | --- | --- |", flush=True)
    equal = True
    for job in _jobs(options.jobs):
        here = _digest([], PROJECT, sys.executable, job)
        there = _digest(["chroot", str(system)], Path("/project"), "/usr/bin/python3", job)
        verdict = "yes" if here == there else "NO"
        if not re.fullmatch(r"[0-9a-f]{16}", here):
            verdict = "not recorded"
        equal &= verdict == "yes"
        print(f"| {job} | {here} | {there} | {verdict} |", flush=True)
    return 0 if equal else 1


def _unpack(system: Path) -> None:
    """Make an ARM Python with rsltrace's dependencies below ``system``."""
    first = ROOT / "debootstrap"
    names = "python3,libc-bin,libgcc-s1,libstdc++6,tzdata"
    options = ["--foreign", "--arch=arm64", "--variant=minbase", f"--include={names}"]
    subprocess.run(["debootstrap", *options, RELEASE, str(first)], check=True)
    for package in sorted((first / "var/cache/apt/archives").glob("*.deb")):
        subprocess.run(["dpkg-deb", "-x", str(package), str(system)], check=True)
    shutil.rmtree(first)
    (system / "tmp").mkdir(exist_ok=True)
    needed = [one for one in metadata.requires("rsltrace") or () if "extra ==" not in one]
    needed += ["pyyaml", "kiss-icp"]  # rclpy's, and that of an example
    wheels = ROOT / "wheels"
    platforms = [f"--platform=manylinux_2_{minor}_aarch64" for minor in GLIBC]
    command = [sys.executable, "-m", "pip", "download", "-qq", "--only-binary=:all:"]
    command += [*platforms, f"--python-version={PYTHON_VERSION}", "--implementation=cp"]
    subprocess.run([*command, f"--dest={wheels}", *needed], check=True)
    for wheel in sorted(wheels.glob("*.whl")):
        with zipfile.ZipFile(wheel) as packed:
            packed.extractall(system / PACKAGES)
    ros = [sys.executable, "-m", "rsltrace", "install-ros", "--into", str(system / PACKAGES)]
    subprocess.run(ros, check=True, stdout=subprocess.DEVNULL)


def _copy_project(target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    for name in FOLDERS:
        shutil.copytree(PROJECT / name, target / name, ignore=ignored)


def _jobs(names: Sequence[str]) -> list[str]:
    """Return the examples' jobs (paths in the project), or those that ``names`` name."""
    found = sorted(PROJECT.glob("examples/*/job*.yaml"))
    jobs = [str(path.relative_to(PROJECT).with_suffix("")) for path in found]
    chosen = [job for job in jobs if not names or any(name in f"{job}/" for name in names)]
    if not chosen:
        raise SystemExit(f"no example is called {' or '.join(names)}; there are {', '.join(jobs)}")
    return chosen


def _digest(prefix: Sequence[str], project: Path, python: str, job: str) -> str:
    """Record a job of ``project`` and return its digest, or the line that says why not."""
    output = f"/tmp/rsltrace-arm-{os.getpid()}.mcap"
    paths = f"PYTHONPATH={project}:{project}/viewer"
    command = [*prefix, "/usr/bin/env", "-C", str(project), paths]
    command += [python, "-m", "rsltrace", "record", f"{job}.yaml", "-o", output, "--force"]
    environment = {"PATH": "/usr/bin:/bin:/usr/sbin", "HOME": "/tmp", "LANG": "C.UTF-8"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    Path(output).unlink(missing_ok=True)
    text = done.stdout + done.stderr
    found = re.search(r"^digest ([0-9a-f]{16}) ", text, re.MULTILINE)
    if found:
        return found[1]
    lines = text.strip().splitlines() or [f"exit status {done.returncode}"]
    return next((line for line in reversed(lines) if "error" in line.lower()), lines[-1])


if __name__ == "__main__":
    sys.exit(main())
