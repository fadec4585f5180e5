"""The table of calls that could make runs differ; the guard and the audit both read it.

To add a rule, add a line to ``RULES`` (see CONTRIBUTING.md, "Add a guard rule").
"""

from __future__ import annotations

import ast
import os
import re
import resource
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.finding import MODES, GuardMode, GuardPolicy, NondeterminismSource

PROCESSORS = 4
"""How many processors user code sees, on every machine."""
PROCESSOR_NAMES = frozenset(("SC_NPROCESSORS_CONF", "SC_NPROCESSORS_ONLN"))
"""What ``os.sysconf`` calls their number."""


class Treatment(str, Enum):
    """What happens to a call in a recorded run.

    ``virtual``: the run answers it; ``pinned``: ``rsltrace record`` fixes what it depends on;
    ``recorded``: the trace keeps the answer; ``detected``: the run reports it; ``refused``: it ends
    the run; ``nothing``: the guard does not see it, or the job allows it.
    """

    VIRTUAL = "virtual"
    PINNED = "pinned"
    RECORDED = "recorded"
    DETECTED = "detected"
    REFUSED = "refused"
    NOTHING = "nothing"


_OF_MODE = {
    GuardMode.VIRTUAL: Treatment.VIRTUAL,
    GuardMode.RECORD: Treatment.RECORDED,
    GuardMode.WARN: Treatment.DETECTED,
    GuardMode.ERROR: Treatment.REFUSED,
    GuardMode.ALLOW: Treatment.NOTHING,
}

ArgumentTest = Callable[[ast.Call], bool]


@dataclass(frozen=True, slots=True)
class Rule:
    """What the guard does about a kind of calls, and what the audit says about them.

    ``does`` describes ``treatment``, ``instead`` what to write in place of the call. ``source`` is
    the key of ``guard:`` that changes the treatment, if any does.
    """

    kind: str
    treatment: Treatment
    does: str
    instead: str
    source: NondeterminismSource | None = None
    is_class: bool = False
    """Naming it is harmless; calling it or deriving from it is not."""
    is_shared: bool = False
    """It draws from a generator that the whole module shares, and may have seeded."""
    when: ArgumentTest | None = None
    """The audit reports only calls with such arguments."""
    reports: NondeterminismSource | None = None
    """The guard replaces the function for the run and reports its calls under this key of
    ``guard:``. Functions without it are replaced by modules of ``guard/virtual`` and
    ``guard/recorded``, reported by audit events, or not seen at all."""
    restore: Callable[[Any], Any] | None = None
    """For ``reports``: under ``record`` the trace keeps the answer, as numbers, texts, lists and
    tuples; this makes the answer from them. None: the call is only reported."""
    answer: Callable[..., Any] | None = None
    """For ``reports``: what the run answers itself, called with the arguments of the call."""

    def treated(self, policy: GuardPolicy | None, whose: str = "the job") -> tuple[Treatment, str]:
        """Return what a guard with this policy (None: no guard at all) does about the call."""
        if policy is None:
            return Treatment.NOTHING, "the job has no guard"
        if self.source is None or self.treatment not in (Treatment.VIRTUAL, Treatment.DETECTED):
            return self.treatment, self.does
        mode = policy.modes[self.source]
        if mode is GuardMode.RECORD and self.reports is not None and self.restore is None:
            mode = GuardMode.WARN  # the call is only reported
        if self.treatment is Treatment.DETECTED and mode is GuardMode.VIRTUAL:
            mode = GuardMode.WARN
        elif self.treatment is Treatment.VIRTUAL and answers(self.source, mode):
            mode = GuardMode.VIRTUAL
        treatment = _OF_MODE[mode]
        if treatment is self.treatment:
            return treatment, self.does
        return treatment, f"{whose} says {self.source.value}: {mode.value}"


def answers(source: NondeterminismSource, mode: GuardMode) -> bool:
    """Return whether the run answers a call itself where it can.

    Sources without a mode ``virtual`` leave only ``allow`` to ask the machine.
    """
    return mode is GuardMode.VIRTUAL or (
        mode is not GuardMode.ALLOW and GuardMode.VIRTUAL not in MODES[source]
    )


_V, _P, _D, _N = Treatment.VIRTUAL, Treatment.PINNED, Treatment.DETECTED, Treatment.NOTHING

_CLOCK = Rule(
    "clock", _V, "shows simulated time", "self.get_clock().now()", NondeterminismSource.CLOCK
)
_CPU_TIME = Rule(
    "clock",
    _D,
    "reported as a finding",
    "an external profiler",
    NondeterminismSource.CLOCK,
    reports=NondeterminismSource.CLOCK,
)
_SLEEP = Rule("sleep", _V, "waits in simulated time", "a timer: self.create_timer(seconds, …)")
_RANDOM = Rule(
    "random",
    _V,
    "draws from the node's seeded stream",
    "a generator with its own seed: random.Random(seed), from a parameter",
    NondeterminismSource.RANDOM,
    is_shared=True,
)
_NUMPY = replace(_RANDOM, instead="np.random.default_rng(seed), the seed from a parameter")
_UNSEEDED = Rule(
    "random",
    _V,
    "is seeded from the node's stream",
    "give it a seed, from a parameter",
    NondeterminismSource.RANDOM,
)
_LEFT = replace(
    _UNSEEDED, does="shows zeros where numpy computes nothing", instead="give it out=np.zeros(…)"
)
_TORCH = replace(
    _UNSEEDED,
    does="is seeded with the job's seed, if torch is loaded when the run begins",
    instead="a torch.Generator with its own seed",
)
_ENTROPY = replace(
    _UNSEEDED,
    does="comes from the node's seeded stream",
    instead="a counter, or bytes of a seeded generator",
)
_OPENSSL = replace(
    _ENTROPY, treatment=_D, does="reported as a finding", reports=NondeterminismSource.RANDOM
)
_THREAD = Rule(
    "thread",
    _V,
    "runs as a cooperative thread in simulated time",
    "timers, tasks or callback groups",
)
_SIGNAL = Rule(
    "thread",
    _D,
    "reported as a finding",
    "a timer: self.create_timer(…)",
    NondeterminismSource.THREAD,
    reports=NondeterminismSource.THREAD,
)
_PROCESS = Rule(
    "process",
    _D,
    "reported as a finding; it runs in real time",
    "do it before the run, or run it outside and record what it sends into a bag",
    NondeterminismSource.PROCESS,
)
_SOCKET = Rule(
    "socket",
    _D,
    "reported as a finding; answers come in real time",
    "record what comes from outside into a bag, or write 'socket: record' below 'guard:'",
    NondeterminismSource.SOCKET,
)
_DEVICE = Rule(
    "socket",
    _N,
    "a library reads it in C, where the guard cannot see it",
    "a driver node outside; record its topics into a bag",
)
_BLOCKING = Rule(
    "blocking", _N, "blocks the whole run in real time", "a topic, a service or a parameter"
)
_TERMINAL = Rule(
    "blocking",
    _V,
    "reads the job's stdin: (without it, that is an error)",
    "a topic, a service or a parameter",
)
ZERO_DURATION = Rule(
    "clock",
    _V,
    "is 0: ROS clocks stand still in a callback, unless the job says clocks: {advances: true}",
    "measure from one callback to the next, or allow for 0",
)
_ASYNC_IO = Rule(
    "blocking",
    _V,
    "its loop waits in simulated time",
    "async callbacks of the node: await client.call_async(…)",
)
_LISTING = Rule("directory", _V, "is sorted", "sorted(…)", NondeterminismSource.DIRECTORY)
ENVIRONMENT = Rule(
    "environment",
    _D,
    "reported as a finding",
    "a parameter of the node",
    NondeterminismSource.ENVIRONMENT,
)
_MACHINE = replace(
    ENVIRONMENT, reports=NondeterminismSource.ENVIRONMENT, restore=lambda answer: answer
)
_INTERPRETER = replace(
    ENVIRONMENT, instead="leave it to a profiler", reports=NondeterminismSource.ENVIRONMENT
)
_PID = Rule(
    "pid",
    _V,
    "is a number of the run's, the same in every run",
    "a parameter of the node",
    NondeterminismSource.PID,
)
_PROCESSORS = Rule(
    "environment",
    _V,
    f"is {PROCESSORS}, on every machine",
    "a parameter of the node, or a constant",
    NondeterminismSource.ENVIRONMENT,
)
_FILE_TIME = Rule(
    "file",
    _D,
    "reported as a finding",
    "the content of the file instead of its age",
    NondeterminismSource.FILE,
)
_DISK = replace(_FILE_TIME, instead="a parameter of the node", reports=NondeterminismSource.FILE)
LOCALE = Rule(
    "locale", _P, "record runs in C.UTF-8", "plain formatting: f'{x:.3f}', key=str.casefold"
)
_SET_LOCALE = Rule(
    "locale", _N, "undoes what record pins", "plain formatting; leave the locale alone"
)
_ZONE = Rule("locale", _P, "record runs in UTC", "give the time zone: tz=timezone.utc")
FINALIZER = Rule(
    "finalizer",
    _P,
    "garbage is collected only between events",
    "destroy_node(), close() or a with block",
)
_COLLECTOR = Rule(
    "finalizer", _N, "runs finalizers in the middle of callbacks", "leave the collector to the run"
)

# Rules for what is not a call of a function by its name: ``audit/calls.py`` finds these.

ORDER = Rule(
    "order",
    _V,
    "its order is the same in every run; objects with equal contents are a finding",
    "sorted(…), or a dict or a list instead of the set",
    NondeterminismSource.ORDER,
)
ADDRESS = Rule(
    "address",
    _D,
    "reported as a finding",
    "a name or a number of your own",
    NondeterminismSource.ADDRESS,
)
HASH = replace(
    ADDRESS,
    does="strings: the hash seed is pinned; addresses: reported as a finding",
    instead="zlib.crc32(text.encode()), or a key of your own",
)
REPLACED_FUNCTION = Rule(
    "replaced",
    _D,
    "the run notes that it is never called, because rsltrace runs callbacks itself",
    "replace rclpy.executors.await_or_execute, or wrap the callbacks",
)
_SQL_CLOCK = Rule(
    "clock",
    _D,
    "reported as a finding",
    "pass the node's time as a parameter",
    NondeterminismSource.CLOCK,
)
_SQL_RANDOM = replace(
    _UNSEEDED, treatment=_D, does="reported as a finding", instead="pass a number"
)
_SQL = re.compile(
    r"'now'|\bCURRENT_(?:TIME|DATE|TIMESTAMP)\b|\b(?:julianday|unixepoch|date|time|datetime)\(\s*\)"
    r"|\bstrftime\([^(),]*\)|\brandom(?:blob)?\(",
    re.IGNORECASE,
)


def sql_call(statement: str) -> tuple[str, Rule] | None:
    """Return the first call in an SQL statement that reads the clock or draws, and its rule."""
    match = _SQL.search(statement)
    if match is None:
        return None
    call = match.group() + ")" * match.group().endswith("(")
    return f"SQLite: {call}", _SQL_RANDOM if call.lower().startswith("random") else _SQL_CLOCK


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def is_unseeded(call: ast.Call) -> bool:
    """Whether a generator is made without a seed."""
    if any(isinstance(argument, ast.Starred) for argument in call.args):
        return False
    seeds = [*call.args[:1], *(word.value for word in call.keywords)]
    return not seeds or all(map(_is_none, seeds))


def _fewer_than(count: int) -> ArgumentTest:
    def test(call: ast.Call) -> bool:
        starred = any(isinstance(argument, ast.Starred) for argument in call.args)
        given = [argument for argument in call.args if not _is_none(argument)]
        return not starred and len(given) + len(call.keywords) < count

    return test


def _leaves_some(call: ast.Call) -> bool:
    """Whether a ufunc is given ``where`` and no array for its results, by name or by place."""
    words = [word.arg for word in call.keywords]
    name = call.func.attr if isinstance(call.func, ast.Attribute) else ""
    inputs = getattr(getattr(np, name, None), "nin", len(call.args))
    return "where" in words and "out" not in words and len(call.args) <= inputs


def _with_callback(call: ast.Call) -> bool:
    return len(call.args) > 1


def _now_text(call: ast.Call) -> bool:
    first = call.args[0] if call.args else None
    return isinstance(first, ast.Constant) and first.value in ("now", "today")


def _from_environment(call: ast.Call) -> bool:
    second = call.args[1] if len(call.args) > 1 else None
    return isinstance(second, ast.Constant) and second.value == ""


def _of_machine(call: ast.Call) -> bool:
    first = call.args[0] if call.args else None
    return not (isinstance(first, ast.Constant) and first.value in PROCESSOR_NAMES)


def _calls(rule: Rule, module: str, names: str, **changes: Any) -> dict[str, Rule]:
    """Return table lines: ``rule``, with ``changes``, for functions or classes of a module."""
    changed = replace(rule, **changes)
    return {f"{module}.{name}": changed for name in names.split()}


def _classes(rule: Rule, module: str, names: str, **changes: Any) -> dict[str, Rule]:
    return _calls(rule, module, names, is_class=True, **changes)


_TIMES = "time monotonic perf_counter process_time thread_time"
_DRAWS = (
    "random uniform triangular randint choice randrange sample choices shuffle normalvariate "
    "lognormvariate expovariate vonmisesvariate gammavariate gauss betavariate paretovariate "
    "weibullvariate getrandbits randbytes binomialvariate"
)
_NUMPY_DRAWS = (
    "rand randn randint random random_sample ranf sample random_integers choice bytes shuffle "
    "permutation uniform normal standard_normal beta binomial chisquare dirichlet exponential f "
    "gamma geometric gumbel hypergeometric laplace logistic lognormal logseries multinomial "
    "multivariate_normal negative_binomial noncentral_chisquare noncentral_f pareto poisson power "
    "rayleigh standard_cauchy standard_exponential standard_gamma standard_t triangular vonmises "
    "wald weibull zipf"
)
_UFUNCS = " ".join(name for name, one in vars(np).items() if isinstance(one, np.ufunc))
_SPAWNS = "spawnl spawnle spawnlp spawnlpe spawnv spawnve spawnvp spawnvpe"
_EXECS = "execl execle execlp execlpe execv execve execvp execvpe"
_REQUESTS = "get post put patch delete head options request Session"

RULES: dict[str, Rule] = {
    **_calls(_CLOCK, "time", f"{_TIMES} " + " ".join(f"{name}_ns" for name in _TIMES.split())),
    **_calls(_CLOCK, "time", "clock_gettime clock_gettime_ns"),
    **_calls(_CLOCK, "time", "localtime gmtime ctime asctime", when=_fewer_than(1)),
    **_calls(_CLOCK, "time", "strftime", when=_fewer_than(2)),
    **_calls(_CLOCK, "datetime.datetime", "now utcnow today"),
    **_calls(_CLOCK, "datetime.date", "today"),
    **_calls(_CLOCK, "timeit", "default_timer"),
    **_calls(_CLOCK, "email.utils", "localtime formatdate", when=_fewer_than(1)),
    **_classes(_CLOCK, "numpy", "datetime64", when=_now_text),
    **_calls(_CPU_TIME, "os", "times", restore=os.times_result),
    **_calls(_CPU_TIME, "resource", "getrusage", restore=resource.struct_rusage),
    **_calls(_CPU_TIME, "cProfile", "run runctx", reports=None),
    **_classes(_CPU_TIME, "cProfile", "Profile", reports=None),
    **_calls(_SLEEP, "time", "sleep"),
    **_calls(_RANDOM, "random", _DRAWS),
    **_classes(_UNSEEDED, "random", "Random", when=is_unseeded),
    **_classes(_UNSEEDED, "_random", "Random", when=is_unseeded),
    **_classes(_ENTROPY, "random", "SystemRandom"),
    **_calls(_RANDOM, "random", "seed", when=is_unseeded),
    **_calls(_LEFT, "numpy", _UFUNCS, when=_leaves_some),
    **_calls(_NUMPY, "numpy.random", _NUMPY_DRAWS),
    **_calls(_NUMPY, "numpy.random", "seed", when=is_unseeded),
    **_calls(_UNSEEDED, "numpy.random", "default_rng", when=is_unseeded),
    **_classes(
        _UNSEEDED,
        "numpy.random",
        "RandomState SeedSequence PCG64 PCG64DXSM MT19937 Philox SFC64",
        when=is_unseeded,
    ),
    **_calls(_ENTROPY, "os", "urandom getrandom"),
    **_calls(_ENTROPY, "uuid", "uuid1 uuid4 getnode"),
    **_calls(_ENTROPY, "secrets", "choice randbelow randbits token_bytes token_hex token_urlsafe"),
    **_calls(_ENTROPY, "tempfile", "mktemp mkstemp mkdtemp"),
    **_classes(_ENTROPY, "tempfile", "NamedTemporaryFile TemporaryDirectory"),
    **_calls(_OPENSSL, "ssl", "RAND_bytes"),
    **_calls(
        _TORCH,
        "torch",
        "rand randn randint randperm normal rand_like randn_like randint_like bernoulli "
        "multinomial poisson",
    ),
    **_classes(_THREAD, "threading", "Thread Timer"),
    **_calls(_THREAD, "_thread", "start_new_thread", reports=NondeterminismSource.THREAD),
    **_calls(_SIGNAL, "_thread", "start_joinable_thread", instead="threading.Thread"),
    **_classes(_THREAD, "concurrent.futures", "ThreadPoolExecutor"),
    **_classes(_THREAD, "concurrent.futures.thread", "ThreadPoolExecutor"),
    **_classes(_THREAD, "multiprocessing.pool", "ThreadPool"),
    **_calls(_SIGNAL, "signal", "alarm setitimer"),
    **_calls(_PROCESS, "subprocess", "run call check_call check_output getoutput getstatusoutput"),
    **_classes(_PROCESS, "subprocess", "Popen"),
    **_calls(
        _PROCESS, "os", f"system popen fork forkpty posix_spawn posix_spawnp {_SPAWNS} {_EXECS}"
    ),
    **_classes(_PROCESS, "multiprocessing", "Process Pool"),
    **_classes(_PROCESS, "multiprocessing.pool", "Pool"),
    **_classes(_PROCESS, "concurrent.futures", "ProcessPoolExecutor"),
    **_calls(_PROCESS, "asyncio", "create_subprocess_exec create_subprocess_shell"),
    **_calls(_PROCESS, "pty", "spawn fork"),
    **_classes(_SOCKET, "socket", "socket"),
    **_calls(_SOCKET, "socket", "create_connection create_server getaddrinfo gethostbyname"),
    **_calls(_SOCKET, "urllib.request", "urlopen urlretrieve"),
    **_classes(_SOCKET, "http.client", "HTTPConnection HTTPSConnection"),
    **_classes(_SOCKET, "http.server", "HTTPServer ThreadingHTTPServer"),
    **_classes(_SOCKET, "socketserver", "TCPServer UDPServer"),
    **_classes(_SOCKET, "ftplib", "FTP FTP_TLS"),
    **_classes(_SOCKET, "smtplib", "SMTP SMTP_SSL"),
    **_classes(_SOCKET, "xmlrpc.client", "ServerProxy"),
    **_calls(_SOCKET, "requests", _REQUESTS),
    **_calls(_SOCKET, "httpx", f"{_REQUESTS} Client AsyncClient stream"),
    **_classes(_SOCKET, "aiohttp", "ClientSession"),
    **_calls(_SOCKET, "websockets", "connect serve"),
    **_calls(_SOCKET, "asyncio", "open_connection start_server"),
    **_classes(_SOCKET, "paho.mqtt.client", "Client"),
    **_classes(_DEVICE, "zmq", "Context"),
    **_classes(_DEVICE, "serial", "Serial"),
    **_classes(_DEVICE, "cv2", "VideoCapture"),
    **_calls(_DEVICE, "grpc", "insecure_channel secure_channel"),
    **_calls(_TERMINAL, "builtins", "input"),
    **_calls(_BLOCKING, "getpass", "getpass"),
    **_calls(_TERMINAL, "sys.stdin", "read readline readlines"),
    **_calls(_BLOCKING, "select", "select poll epoll"),
    **_calls(_BLOCKING, "signal", "pause sigwait sigwaitinfo sigtimedwait"),
    **_calls(_BLOCKING, "os", "wait waitpid wait3 wait4"),
    **_calls(_BLOCKING, "fcntl", "flock lockf"),
    **_calls(_ASYNC_IO, "asyncio", "run"),
    **_calls(_LISTING, "os", "listdir scandir walk fwalk"),
    **_calls(_LISTING, "glob", "glob iglob"),
    **_calls(ENVIRONMENT, "os", "getenv getenvb"),
    **_calls(_MACHINE, "os", "getppid getcwd getcwdb getlogin getloadavg getpgrp nice getpriority"),
    **_calls(_MACHINE, "os", "getuid geteuid getgid getegid getgroups isatty ttyname"),
    **_calls(_MACHINE, "pwd", "getpwuid getpwnam getpwall", restore=None),
    **_calls(_MACHINE, "grp", "getgrgid getgrnam getgrall", restore=None),
    **_calls(_MACHINE, "socket", "if_nameindex"),
    **_calls(_MACHINE, "site", "getuserbase getusersitepackages"),
    **_calls(_MACHINE, "tempfile", "gettempdir gettempdirb"),
    **_calls(_MACHINE, "rclpy.logging", "get_logging_directory", restore=None),
    **_calls(_MACHINE, "os", "uname", restore=os.uname_result),
    **_calls(_MACHINE, "os", "getpgid getsid umask", restore=None),
    **_calls(_MACHINE, "resource", "getrlimit prlimit", restore=tuple),
    **_calls(_MACHINE, "os", "sysconf", when=_of_machine),
    **_calls(_MACHINE, "_thread", "get_native_id"),
    **_calls(ENVIRONMENT, "threading", "get_native_id"),
    **_calls(_INTERPRETER, "gc", "get_stats get_objects get_referrers get_freeze_count"),
    **_calls(_INTERPRETER, "gc", "get_count", restore=lambda answer: answer),
    **_calls(_INTERPRETER, "tracemalloc", "get_traced_memory take_snapshot"),
    **_calls(_INTERPRETER, "sys", "getallocatedblocks getrefcount"),
    **_calls(_PROCESSORS, "os", "process_cpu_count sched_getaffinity"),
    **_calls(
        _PROCESSORS,
        "os",
        "cpu_count",
        reports=NondeterminismSource.ENVIRONMENT,
        answer=lambda: PROCESSORS,
    ),
    **_calls(_PROCESSORS, "multiprocessing", "cpu_count"),
    **_calls(_PID, "os", "getpid"),
    **_calls(ENVIRONMENT, "os.path", "expanduser expandvars"),
    **_calls(ENVIRONMENT, "pathlib.Path", "cwd home"),
    **_calls(ENVIRONMENT, "platform", "node uname platform machine processor release version"),
    **_calls(ENVIRONMENT, "socket", "gethostname getfqdn"),
    **_calls(ENVIRONMENT, "getpass", "getuser"),
    **_calls(
        ENVIRONMENT,
        "psutil",
        "cpu_percent cpu_times cpu_freq virtual_memory swap_memory disk_usage net_io_counters "
        "sensors_temperatures boot_time pids process_iter Process",
    ),
    **_calls(ADDRESS, "numpy", "byte_bounds", reports=NondeterminismSource.ADDRESS),
    **_calls(ADDRESS, "numpy.lib.array_utils", "byte_bounds", reports=NondeterminismSource.ADDRESS),
    **_calls(_FILE_TIME, "os.path", "getmtime getatime getctime"),
    **_calls(_DISK, "os", "statvfs fstatvfs"),
    **_calls(_DISK, "os", "access readlink", restore=lambda answer: answer),
    **_calls(
        LOCALE,
        "locale",
        "getlocale getdefaultlocale getpreferredencoding localeconv format_string currency str "
        "strcoll strxfrm nl_langinfo",
    ),
    **_calls(_SET_LOCALE, "locale", "setlocale", when=_from_environment),
    **_calls(_ZONE, "datetime.datetime", "fromtimestamp", when=_fewer_than(2)),
    **_calls(_ZONE, "time", "mktime tzname timezone altzone"),
    **_calls(FINALIZER, "weakref", "ref proxy", when=_with_callback),
    **_calls(FINALIZER, "weakref", "finalize"),
    **_calls(_COLLECTOR, "gc", "enable set_threshold"),
}
"""The rules by the full names of functions and classes."""

SHARED_GENERATORS = {"random.": "random.seed", "numpy.random.": "numpy.random.seed"}
"""A module that calls the second with a seed may call the functions that begin with the first."""

METHODS = {"iterdir": _LISTING, "rglob": _LISTING, "inode": _FILE_TIME, "buffer_info": ADDRESS}
"""Rules for methods by their names alone, whatever object they are called on."""

ATTRIBUTES = {
    **dict.fromkeys(("__array_interface__", "__array_struct__", "ctypes.data"), ADDRESS),
    **{
        f"st_{name}": _FILE_TIME
        for name in "ino mtime mtime_ns atime atime_ns ctime ctime_ns".split()
    },
}
"""Rules for attributes by their last names."""

REPORTED_MEMBERS: dict[str, NondeterminismSource] = {
    "array.array.buffer_info": NondeterminismSource.ADDRESS,
    "ctypes.c_void_p.value": NondeterminismSource.ADDRESS,
    "ctypes.c_void_p.__repr__": NondeterminismSource.ADDRESS,
    "numpy.ndarray.__array_interface__": NondeterminismSource.ADDRESS,
    "numpy.generic.__array_interface__": NondeterminismSource.ADDRESS,
    "numpy._core._internal._ctypes.data": NondeterminismSource.ADDRESS,
    "numpy.core._internal._ctypes.data": NondeterminismSource.ADDRESS,
    "_lsprof.Profiler.getstats": NondeterminismSource.CLOCK,
    "io.TextIOWrapper.isatty": NondeterminismSource.ENVIRONMENT,
    "threading.Thread.native_id": NondeterminismSource.ENVIRONMENT,
    "os.DirEntry.stat": NondeterminismSource.FILE,
    "os.DirEntry.inode": NondeterminismSource.FILE,
}
"""Methods and properties that the guard reports: addresses in user code itself, others where user
code leads to them."""

AUDIT_EVENTS: dict[str, NondeterminismSource] = {
    **dict.fromkeys(
        (
            *("subprocess.Popen", "os.system", "os.exec", "os.fork", "os.forkpty"),
            *("os.posix_spawn", "os.spawn", "os.kill"),
        ),
        NondeterminismSource.PROCESS,
    ),
    **dict.fromkeys(
        (
            *("socket.connect", "socket.bind", "socket.sendto", "socket.sendmsg"),
            *("socket.getaddrinfo", "socket.gethostbyname", "socket.gethostbyaddr"),
            "socket.gethostname",
        ),
        NondeterminismSource.SOCKET,
    ),
}
"""Audit events of Python that the guard reports, named as Python names them."""

C_FUNCTIONS: dict[str, NondeterminismSource] = {
    name: source
    for source, names in {
        NondeterminismSource.CLOCK: (
            "time clock clock_gettime gettimeofday timespec_get ftime times getrusage getitimer"
        ),
        NondeterminismSource.RANDOM: (
            "rand random drand48 lrand48 mrand48 getrandom getentropy arc4random arc4random_buf "
            "arc4random_uniform tmpnam tempnam tmpfile mktemp mkstemp mkdtemp"
        ),
        NondeterminismSource.PID: "getpid",
        NondeterminismSource.ENVIRONMENT: (
            "getppid getpgrp gettid getenv secure_getenv environ getcwd getwd get_current_dir_name "
            "gethostname gethostid uname sysinfo sysconf getauxval getloadavg getlogin getrlimit "
            "sched_getcpu getcpu get_nprocs syscall"
        ),
        NondeterminismSource.FILE: "open open64 openat fopen fopen64 stat fstat readlink opendir",
        NondeterminismSource.SOCKET: "socket connect recv recvfrom accept getaddrinfo",
        NondeterminismSource.PROCESS: "system popen fork vfork posix_spawn execv execve execvp",
        NondeterminismSource.THREAD: "pthread_create pthread_self alarm setitimer timer_create",
        NondeterminismSource.ADDRESS: (
            "malloc calloc realloc aligned_alloc posix_memalign mmap sbrk PyObject_Hash "
            "_Py_HashPointer PyLong_FromVoidPtr PyCapsule_GetPointer"
        ),
    }.items()
    for name in names.split()
}
"""Functions and variables of the C library and of Python that the guard reports when nodes load
them by ctypes or cffi."""


def c_function_rule(name: str) -> Rule | None:
    """Return the rule for such a function, if it has one."""
    source = C_FUNCTIONS.get(name)
    if source is None:
        return None
    instead = "the function of Python's own modules, or a parameter of the node"
    return Rule(source.value, _D, "reported as a finding", instead, source)
