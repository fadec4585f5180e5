"""The file under a trace, while somebody else in the process, or beside it, does things to it."""

from __future__ import annotations

import ctypes
import mmap
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from rsltrace.errors import OutputError
from rsltrace.trace.mcap.sink import Sink, unfinished_path

MAGIC = b"\x89MCAP0\r\n"
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="traces are recorded on Linux")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def begun(path: Path, *, force: bool = False) -> Sink:
    sink = Sink(path, force=force)
    sink.write(MAGIC)
    sink.write(b"first")
    return sink


def append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"x")


def rewrite(path: Path) -> None:
    with path.open("r+b") as file:
        file.seek(9)
        file.write(b"!")


def swap(path: Path) -> None:
    path.rename(path.with_suffix(".moved"))
    path.write_bytes(MAGIC + b"first")


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (Path.unlink, "it was deleted"),
        (lambda path: os.truncate(path, 3), "it has 3 bytes and should have 13"),
        (lambda path: path.write_bytes(b""), "it has 0 bytes and should have 13"),
        (append, "it has 14 bytes and should have 13"),
    ],
)
def test_what_is_done_to_the_file_is_found_at_the_next_write(
    path: Path, harm: Callable[[Path], object], said: str
) -> None:
    sink = begun(path)
    harm(path)
    for _ in range(2):
        with pytest.raises(OutputError, match=rf"{path} was changed .*: {said}; look"):
            sink.write(b"second")
    sink.close()


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (Path.unlink, "it was deleted"),
        (rewrite, "its content is not what was written"),
        (swap, "it was renamed, or another file has its name"),
        (lambda path: path.rename(path.with_suffix(".old")), "it was renamed, or another"),
    ],
)
def test_a_file_that_is_not_what_was_written_is_never_finished(
    path: Path, harm: Callable[[Path], object], said: str
) -> None:
    sink = begun(path)
    harm(path)
    with pytest.raises(OutputError, match=said):
        sink.finish()
    sink.close()


def test_a_large_file_is_read_back_if_its_time_says_that_it_was_touched(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rsltrace.trace.mcap.sink._READ_BACK_BYTES", 0)
    sink = begun(path)
    rewrite(path)
    os.utime(path, ns=(1, 1))  # a clock's tick later, as it were
    sink.write(b"second")
    with pytest.raises(OutputError, match="its content is not what was written"):
        sink.finish()
    sink.close()


def close_all(fd: int) -> None:
    os.close(fd)


def put_another_in_its_place(fd: int) -> None:
    other = os.open("own.txt", os.O_CREAT | os.O_WRONLY)
    os.dup2(other, fd)
    os.close(other)


@pytest.mark.parametrize("harm", [close_all, put_another_in_its_place])
def test_a_descriptor_that_was_taken_away_is_opened_again(
    path: Path, monkeypatch: pytest.MonkeyPatch, harm: Callable[[int], None]
) -> None:
    monkeypatch.chdir(path.parent)
    sink = begun(Path("run.mcap"))
    number = sink._descriptor.number
    harm(number)
    os.mkdir("elsewhere")
    monkeypatch.chdir("elsewhere")
    sink.write(b"second")
    if harm is put_another_in_its_place:
        os.close(number)  # it is that file's, and is left open
    harm(sink._descriptor.number)
    monkeypatch.chdir(path.parent / "elsewhere")
    sink.finish()
    assert path.read_bytes() == MAGIC + b"firstsecond"
    if harm is put_another_in_its_place:
        assert (path.parent / "own.txt").read_bytes() == b""


def test_a_descriptor_is_out_of_the_way_and_not_inherited(path: Path) -> None:
    sink = begun(path)
    number = sink._descriptor.number
    assert number > 100
    assert not os.get_inheritable(number)
    sink.close()


def test_a_moved_position_moves_nothing(path: Path) -> None:
    sink = begun(path)
    os.lseek(sink._descriptor.number, 0, os.SEEK_SET)
    sink.write(b"second")
    sink.finish()
    assert path.read_bytes() == MAGIC + b"firstsecond"


def test_a_forked_child_has_no_descriptor_and_cannot_write(path: Path) -> None:
    sink = begun(path)
    number = sink._descriptor.number
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.fstat(number)
        except OSError:
            try:
                sink.write(b"of the child")
            except OutputError:
                sink.close()
                status = 0
        os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    sink.write(b"second")
    sink.finish()
    assert path.read_bytes() == MAGIC + b"firstsecond"


# -- what was there -------------------------------------------------------------------------------


def test_what_is_replaced_stays_until_the_new_one_is_whole(path: Path) -> None:
    path.write_bytes(MAGIC + b"old")
    path.chmod(0o640)
    sink = begun(path, force=True)
    assert sink.place == unfinished_path(path) == path.parent / "run.unfinished.mcap"
    assert sink.place.read_bytes() == MAGIC + b"first"
    assert path.read_bytes() == MAGIC + b"old"
    sink.finish()
    assert sink.place == path
    assert path.read_bytes() == MAGIC + b"first"
    assert path.stat().st_mode & 0o777 == 0o640
    assert list(path.parent.iterdir()) == [path]


def test_what_was_given_up_is_beside_what_was_there(path: Path) -> None:
    path.write_bytes(MAGIC + b"old")
    begun(path, force=True).close()
    sink = begun(path, force=True)  # takes the place of what was given up
    sink.write(b"more")
    sink.finish(replace=False)
    assert sink.place == unfinished_path(path)
    assert sink.place.read_bytes() == MAGIC + b"firstmore"
    assert path.read_bytes() == MAGIC + b"old"


@pytest.mark.parametrize("how", ["deleted", "cut", "replaced", "written over"])
def test_what_was_there_is_not_said_to_be_as_it_was_if_it_is_not(path: Path, how: str) -> None:
    path.write_bytes(MAGIC + b"old")
    os.utime(path, ns=(1, 1))  # older than a tick of the kernel's clock
    sink = begun(path, force=True)
    assert sink.kept == f"{path} is as it was"
    if how in ("deleted", "replaced"):
        path.unlink()
    if how == "cut":
        os.truncate(path, 3)
    elif how != "deleted":
        path.write_bytes(MAGIC + b"new")
    said = f"{path} was changed or deleted while the run went on, but not by rsltrace"
    assert sink.kept == said
    os.truncate(sink.place, 2)
    with pytest.raises(OutputError, match=re.escape(said)):
        sink.write(b"more")


def test_a_link_leads_to_what_is_replaced(path: Path) -> None:
    (path.parent / "disk").mkdir()
    real = path.parent / "disk" / "real.mcap"
    real.write_bytes(MAGIC)
    path.symlink_to(real)
    sink = begun(path, force=True)
    assert sink.place == path.parent / "disk" / "real.unfinished.mcap"
    sink.finish()
    assert path.is_symlink()
    assert real.read_bytes() == MAGIC + b"first"


def test_nothing_but_a_trace_is_taken_for_one_that_was_given_up(path: Path) -> None:
    path.write_bytes(MAGIC)
    unfinished_path(path).write_text("precious")
    with pytest.raises(
        OutputError, match=r"run\.unfinished\.mcap: the existing file is not a trace"
    ):
        Sink(path, force=True)
    unfinished_path(path).unlink()
    unfinished_path(path).symlink_to(path.parent / "elsewhere")
    with pytest.raises(OutputError, match=r"run\.unfinished\.mcap"):
        Sink(path, force=True)
    assert not (path.parent / "elsewhere").exists()
    assert path.read_bytes() == MAGIC


@pytest.mark.parametrize("there", [False, True])
def test_two_runs_do_not_write_one_trace(path: Path, there: bool) -> None:
    if there:
        path.write_bytes(MAGIC + b"old")
    sink = begun(path, force=True)
    with pytest.raises(OutputError, match="another run is writing it; wait, or choose"):
        Sink(path, force=True)
    sink.finish()
    begun(path, force=True).finish()


def test_a_file_in_which_nothing_is_does_not_stay(path: Path) -> None:
    script = (
        "import resource, signal, sys\n"
        "from pathlib import Path\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
        "from rsltrace.errors import OutputError\n"
        "from rsltrace.trace.writer import TraceWriter\n"
        "try:\n    TraceWriter(Path(sys.argv[1]), force=False)\n"
        "except OutputError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
    )
    assert f"cannot go on writing the trace {path}: File too large (EFBIG)" in done.stdout
    assert not path.exists()


@pytest.mark.parametrize("force", [False, True])
def test_pipes_and_devices_are_no_files(path: Path, force: bool) -> None:
    os.mkfifo(path)
    with pytest.raises(OutputError, match=r"run\.mcap: it is a named pipe"):
        Sink(path, force=force)
    with pytest.raises(OutputError, match="/dev/null: it is a device"):
        Sink(Path("/dev/null"), force=force)


AS_SOMEBODY_ELSE = """
import os, sys
from pathlib import Path
from rsltrace.errors import OutputError
from rsltrace.trace.writer import TraceWriter
os.setgid(65534)
os.setuid(65534)
try:
    TraceWriter(Path(sys.argv[1]), force=sys.argv[2] == "force")
except OutputError as error:
    print(error)
"""


@pytest.mark.parametrize("there", ["", "force"])
def test_a_folder_of_somebody_else(there: str) -> None:
    """As somebody else than root, who may write anywhere."""
    if os.getuid() != 0:
        pytest.skip("only root may become somebody else")
    with TemporaryDirectory() as folder:  # the folders of tests are their owner's alone
        os.chmod(folder, 0o755)
        path = Path(folder, "run.mcap")
        if there:
            path.write_bytes(MAGIC)
        done = subprocess.run(
            [sys.executable, "-c", AS_SOMEBODY_ELSE, str(path), there],
            capture_output=True,
            text=True,
            check=True,
        )
        place = unfinished_path(path) if there else path
        assert f"cannot write the trace {place}: Permission denied; choose another" in done.stdout
        assert path.exists() == bool(there)


@pytest.mark.skipif(not hasattr(os, "posix_fadvise"), reason="Linux has it")
def test_what_is_written_far_into_a_file_does_not_stay_in_the_cache(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mib = 1 << 20
    probe = path.with_name("probe")
    probe.write_bytes(bytes(mib))
    with probe.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, mib, os.POSIX_FADV_DONTNEED)
    if any(_kept_in_cache(probe)):
        pytest.skip("a file system that is nowhere but in memory")
    monkeypatch.setattr("rsltrace.trace.mcap.sink._CACHED_BYTES", 8 * mib)
    monkeypatch.setattr("rsltrace.trace.mcap.sink._RELEASED_BYTES", 2 * mib)
    sink = begun(path)
    written = [bytes([n]) * mib for n in range(32)]
    for data in written:
        sink.write(data)
        with path.open("rb") as file:
            os.fsync(file.fileno())
    kept = _kept_in_cache(path)
    sink.finish()
    assert path.read_bytes() == MAGIC + b"first" + b"".join(written)
    pages = 8 * mib // mmap.PAGESIZE
    assert all(kept[:pages])
    assert not any(kept[pages + 1 : 24 * mib // mmap.PAGESIZE])


def _kept_in_cache(path: Path) -> list[bool]:
    """Return of each page of a file whether the kernel has it in its cache."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    size = path.stat().st_size
    with path.open("rb") as file:
        mapped = libc.mmap(
            None, ctypes.c_size_t(size), mmap.PROT_READ, mmap.MAP_SHARED, file.fileno(), 0
        )
    states = (ctypes.c_ubyte * (-(-size // mmap.PAGESIZE)))()
    assert libc.mincore(ctypes.c_void_p(mapped), ctypes.c_size_t(size), states) == 0
    libc.munmap(ctypes.c_void_p(mapped), ctypes.c_size_t(size))
    return [bool(state & 1) for state in states]
