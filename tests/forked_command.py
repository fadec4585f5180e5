"""``rsltrace record`` and ``replay`` in a fork of a process that has loaded them.

Starting Python and loading nodes' libraries takes a second, a fork some milliseconds. It is a
process of its own: it may be killed, close what it likes and end as it likes. What a fresh start
does (the environment of Python, the pin) has tests of its own, with fresh processes.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from rsltrace.guard.pin import PINNED_VARIABLES, has_fixed_addresses, pin

FRESH = frozenset(("--no-pin", "--help", "-h"))
"""Words that ask for a process that is not pinned."""


def can_fork(words: Sequence[str], env: Mapping[str, str]) -> bool:
    """Return whether a fork does what a fresh ``rsltrace`` with these words would do."""
    ours = {name: value for name, value in os.environ.items() if name.startswith("PYTHON")}
    theirs = {name: value for name, value in env.items() if name.startswith("PYTHON")}
    if words[:1] not in (["record"], ["replay"]) or FRESH.intersection(words):
        return False
    return ours == theirs


class Forks:
    """The process that forks, started when it is needed for the first time."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._server: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    def run(
        self, words: Sequence[str], cwd: Path, env: Mapping[str, str], timeout_s: float
    ) -> subprocess.CompletedProcess[str]:
        """Run the command as ``subprocess.run`` with captured text would."""
        with self._one_at_a_time:
            try:
                return self._run(list(words), cwd, env, timeout_s)
            except BaseException:
                self.close()  # whatever it still has to say is no answer to what comes next
                raise

    def _run(
        self, words: list[str], cwd: Path, env: Mapping[str, str], timeout_s: float
    ) -> subprocess.CompletedProcess[str]:
        server = self._socket or self._start()
        pipes = [os.pipe(), os.pipe()]
        request = {"words": words, "cwd": str(cwd), "env": _pinned(env)}
        socket.send_fds(server, [json.dumps(request).encode()], [write for _, write in pipes])
        for _, write in pipes:
            os.close(write)
        texts = ["", ""]
        readers = [
            threading.Thread(target=_read, args=(read, texts, number), daemon=True)
            for number, (read, _) in enumerate(pipes)
        ]
        for reader in readers:
            reader.start()
        pid = int(server.recv(100))
        timed_out = False
        for reader in readers:
            reader.join(timeout_s)
            if reader.is_alive():
                timed_out = True
                with suppress(ProcessLookupError):  # somebody else holds the pipe
                    os.kill(pid, signal.SIGKILL)
                break
        status = int(server.recv(100))
        if timed_out:
            raise subprocess.TimeoutExpired(words, timeout_s, *texts)
        return subprocess.CompletedProcess(words, status, *texts)

    def _start(self) -> socket.socket:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._server = subprocess.Popen(
                [sys.executable, "-m", __name__, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                cwd=Path(__file__).parents[1],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        return self._socket

    def close(self) -> None:
        """End the process."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._server is not None:
            self._server.wait(60)
            self._server = None


def _read(descriptor: int, texts: list[str], number: int) -> None:
    with open(descriptor, encoding="utf-8") as file:
        texts[number] = file.read()


def _pinned(env: Mapping[str, str]) -> dict[str, str]:
    """Return the environment that ``pin`` starts a command with."""
    before = {name: env.get(name) for name in PINNED_VARIABLES}
    told = {**before, "addresses": not has_fixed_addresses()}
    return {**env, **PINNED_VARIABLES, "RSLTRACE_PINNED": repr(told)}


def serve(requests: socket.socket) -> list[str] | None:
    """Fork for each request. In a fork return the words to run; at the end return None."""
    while True:
        data, (*streams,), _, _ = socket.recv_fds(requests, 1 << 20, 2)
        if not data:
            return None
        request = json.loads(data)
        pid = os.fork()
        if pid == 0:
            requests.close()
            for number, stream in enumerate(streams, 1):
                os.dup2(stream, number)
                os.close(stream)
            os.chdir(request["cwd"])
            os.environ.clear()
            os.environ.update(request["env"])
            sys.path[0] = request["cwd"]
            words: list[str] = request["words"]
            return words
        for stream in streams:
            os.close(stream)
        requests.send(str(pid).encode())
        _, status = os.waitpid(pid, 0)
        requests.send(str(os.waitstatus_to_exitcode(status)).encode())


def main() -> None:
    """Serve whoever holds the other end of the socket whose descriptor is the argument."""
    pin()
    import gc

    import rclpy.node  # noqa: F401
    import std_msgs.msg  # noqa: F401

    import rsltrace.cli.record
    import rsltrace.cli.replay
    import rsltrace.run  # noqa: F401
    from rsltrace.cli.start import main as command

    gc.freeze()
    try:
        words = serve(socket.socket(fileno=int(sys.argv[1])))
    except KeyboardInterrupt:
        words = None
    if words is not None:
        sys.argv = ["rsltrace", *words]
        sys.orig_argv = [sys.executable, "-m", *sys.argv]
        command()


if __name__ == "__main__":
    main()
