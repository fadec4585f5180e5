"""Copies of the process of a simulation: exact ones, and why there can be none.

The kernel's (or C library's) ``fork`` is called, not Python's: that one makes the copy a process of
its own in many ways (locks, threads, random generators, event loops), and a checkpoint is to be the
same process once more. That takes a process with a single thread, which a simulation is, unless a
library has started real ones.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import stat
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

from rsltrace.errors import DebugError

_PR_SET_PDEATHSIG, _PR_GET_TID_ADDRESS = 1, 40
_CALLS = {"x86_64": (56, 273, 274), "aarch64": (220, 99, 100)}
"""The numbers of the kernel's ``clone``, ``set_robust_list`` and ``get_robust_list``."""
_MACHINE = os.uname().machine
_CLONE_PARENT, _CLONE_CHILD_CLEARTID, _CLONE_CHILD_SETTID = 0x8000, 0x200000, 0x1000000
_SIGCHLD = 17
_NULL = ctypes.c_void_p()
_PID = struct.Struct("<q")
_SIGKILL = 9
_LOOK_US = 200
_c = ctypes.PyDLL(None, use_errno=True)  # keeps Python's lock, which nobody else would release
_SHARED = ("/dev/ptmx", "anon_inode:[eventfd]", "anon_inode:[timerfd]", "anon_inode:inotify")
_KEPT_FLAGS = os.O_APPEND | os.O_NONBLOCK


def end_process(status: int) -> None:
    """End this process at once, whatever a node has put in the place of ``os._exit``."""
    _c._exit(status)


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when ``parent`` ends, whose child it is."""
    _c.prctl(_PR_SET_PDEATHSIG, _SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        end_process(0)


Pairs = Sequence[tuple[int, int]]
"""Descriptors of the two ends of pipes and of pairs of sockets, both in this process."""


def why_not(
    kept: Iterable[int], idle: frozenset[int], pairs: Pairs, apart: Iterable[int] = ()
) -> str:
    """Return why this process cannot be copied, "" if it can. ``kept`` are descriptors of ours,
    ``idle`` the threads that do nothing in a simulation, ``apart`` the processes started by this
    one that are not of it."""
    names = [name for thread, name in _threads() if thread not in idle]
    if names:
        return (
            f"{len(names)} real thread{'s' * (len(names) > 1)} of a library run in it "
            f"({', '.join(sorted(set(names))[:4])}), which no copy would have"
        )
    ours, inner = set(kept), {number for pair in pairs for number in pair}
    for number, target, mode in open_descriptors():
        if number in ours or number < 3:
            continue
        if number in inner and not _waiting_bytes(number):
            continue
        if target.startswith("/dev/nvidia"):
            return "it uses a GPU, which cannot be copied"
        if target.startswith(_SHARED):
            return f"a node has {target} open (descriptor {number}), which both copies would share"
        if stat.S_ISSOCK(mode):
            return f"a node has a socket open (descriptor {number}), which both copies would share"
        if stat.S_ISFIFO(mode):
            return f"a node has a pipe open (descriptor {number}), which both copies would share"
        if stat.S_ISREG(mode) and _is_read_and_written(number):
            return (
                f"a node has {target} open for reading and writing: what it writes there would not "
                "be taken back"
            )
    others = set(apart)
    children = [child for child in own_children() if child not in others]
    if children:
        return f"a node has started a process ({', '.join(map(str, children[:4]))})"
    shared = _shared_memory()
    return f"a node shares memory with other processes ({shared})" if shared else ""


def fork_beside(parent: int, pairs: Pairs) -> int:
    """Fork a process that is a child of ``parent``, as this one is; return its id, 0 in itself.

    Both go on from here with files of their own (what one reads moves no position of the other's)
    and with ``pairs`` of their own, which are empty.

    :raises DebugError: if no process can be made.
    """
    read_end, write_end = os.pipe()
    try:
        is_copy = _is_copy_of_one() if _may_clone() else _is_copy_of_many()
        if is_copy:
            with suppress(BaseException):
                die_with_parent(parent)
                _reopen_files()
                _renew(pairs)
                os.write(write_end, _PID.pack(_c.getpid()))  # for which the other one waits
                return 0
            end_process(1)
        os.close(write_end)
        write_end = -1
        data = os.read(read_end, _PID.size)
    finally:
        os.close(read_end)
        if write_end >= 0:
            os.close(write_end)
    if not data:
        raise DebugError("no process can be made for a checkpoint (see ulimit -u)")
    return int(_PID.unpack(data)[0])


def fork_below(pairs: Pairs) -> int:
    """Fork a process that is a child of this one and dies with it; return its id, 0 in itself. It
    has files and ``pairs`` of its own, as from ``fork_beside``.

    :raises DebugError: if no process can be made.
    """
    parent = os.getpid()
    pid = _clone(0) if _may_clone() else _c.fork()
    if not _is_copy(pid):
        return int(pid)
    try:
        die_with_parent(parent)
        _reopen_files()
        _renew(pairs)
    except BaseException:
        end_process(1)
    return 0


def _may_clone() -> bool:
    return _MACHINE in _CALLS and not other_threads()


def _is_copy_of_one() -> bool:
    """Fork a process with the same parent; say whether this is the new one."""
    return _is_copy(_clone(_CLONE_PARENT))


def _clone(more_flags: int) -> int:
    """Fork a process; return its id, 0 in itself, less than 0 where none can be made.

    The kernel is called as the C library's ``fork`` calls it. In a process with one thread, that
    does nothing else but call handlers (``pthread_atfork``), which see to locks and threads of
    others, and to generators of random numbers: a checkpoint is to have the same ones.
    """
    clone, set_robust_list, get_robust_list = _CALLS[_MACHINE]
    tid, robust, size = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_size_t()
    _c.prctl(_PR_GET_TID_ADDRESS, ctypes.byref(tid), _NULL, _NULL, _NULL)
    _c.syscall(get_robust_list, _NULL, ctypes.byref(robust), ctypes.byref(size))
    flags = more_flags | _SIGCHLD
    if tid:
        flags |= _CLONE_CHILD_SETTID | _CLONE_CHILD_CLEARTID
    last = (tid, _NULL) if _MACHINE == "x86_64" else (_NULL, tid)  # tid and tls change places
    pid = _c.syscall(clone, ctypes.c_long(flags), _NULL, _NULL, *last)
    if pid == 0 and robust:
        _c.syscall(set_robust_list, robust, size)
    return int(pid)


def _is_copy_of_many() -> bool:
    """The same, where others may hold locks that ``fork`` knows of: its child's child."""
    pid = _c.fork()
    if not _is_copy(pid):
        with suppress(ChildProcessError):  # a node ignores the ends of its children
            os.waitpid(pid, 0)
        return False
    # Between the two: with its end ``parent`` becomes the new process's parent.
    between = _c.getpid()
    if _c.fork():
        end_process(0)
    while _c.getppid() == between:
        _c.usleep(_LOOK_US)
    return True


def _is_copy(pid: int) -> bool:
    if pid < 0:
        code = ctypes.get_errno()
        raise DebugError(f"no process can be made for a checkpoint: {os.strerror(code)}")
    return pid == 0


# -- what there is ---------------------------------------------------------------------------------


def other_threads() -> frozenset[int]:
    """Return the threads beside the one that calls."""
    return frozenset(thread for thread, _ in _threads())


def _threads() -> Iterator[tuple[int, str]]:
    """Yield the threads beside the one that calls, with their names."""
    own = os.getpid()
    for name in os.listdir("/proc/self/task"):
        if int(name) != own:
            with suppress(OSError), open(f"/proc/self/task/{name}/comm") as file:
                yield int(name), file.read().strip()


def own_children() -> list[int]:
    """Return the processes that this one has started."""
    found = []
    with suppress(OSError):  # without /proc
        for task in os.listdir("/proc/self/task"):
            with suppress(OSError), open(f"/proc/self/task/{task}/children") as file:
                found += [int(word) for word in file.read().split()]
    return found


def _shared_memory() -> str:
    """Return what of this process's memory would not be copied, "" if all of it would."""
    with suppress(OSError), open("/proc/self/maps", "rb") as file:
        for line in file:
            if b" rw-s " in line or b" rwxs " in line:
                return line.split(maxsplit=5)[-1].decode(errors="replace").strip()
    return ""


def open_descriptors() -> Iterator[tuple[int, str, int]]:
    """Yield number, target and mode of what is open."""
    for name in os.listdir("/proc/self/fd"):
        number = int(name)
        with suppress(OSError):  # that which has read the folder is gone again
            yield number, os.readlink(f"/proc/self/fd/{name}"), os.fstat(number).st_mode


def _waiting_bytes(number: int) -> bool:
    count = ctypes.c_int(0)
    with suppress(OSError):
        fcntl.ioctl(number, 0x541B, count)  # FIONREAD
    return count.value > 0


def _is_read_and_written(number: int) -> bool:
    return fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDWR


def _reopen_files() -> None:
    """Give this process descriptors of its own of all files, at the same positions."""
    for number, _, mode in list(open_descriptors()):
        if number < 3 or not stat.S_ISREG(mode):
            continue
        with suppress(OSError):
            flags = fcntl.fcntl(number, fcntl.F_GETFL)
            kept = flags & (os.O_ACCMODE | _KEPT_FLAGS)
            own = os.open(f"/proc/self/fd/{number}", kept | os.O_CLOEXEC)
            if not flags & os.O_APPEND:
                os.lseek(own, os.lseek(number, 0, os.SEEK_CUR), os.SEEK_SET)
            os.dup2(own, number, inheritable=os.get_inheritable(number))
            os.close(own)


def _renew(pairs: Pairs) -> None:
    """Give this process pipes and pairs of sockets of its own."""
    for one, other in pairs:
        if stat.S_ISFIFO(os.fstat(one).st_mode):
            ends = os.pipe()
            if fcntl.fcntl(one, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY:
                ends = ends[1], ends[0]
        else:
            with socket.socket(fileno=os.dup(one)) as like:
                first, second = socket.socketpair(like.family, like.type)
            ends = first.detach(), second.detach()
        for number, end in zip((one, other), ends, strict=True):
            os.set_blocking(end, os.get_blocking(number))
            os.dup2(end, number, inheritable=os.get_inheritable(number))
            os.close(end)
