"""Which calls are worth a line: by their full names, whatever a module calls them."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from fnmatch import fnmatchcase
from pathlib import Path

from rsltrace.trace.model.finding import Mode, Policy, Source

# What an audit finds: the place, the call, what the guard does about it, what to write instead.


class Treatment(str, Enum):
    """What becomes of a call in a recorded run.

    ``virtual``: the run answers it; ``pinned``: ``rsltrace record`` fixes what it depends on;
    ``recorded``, ``detected``, ``refused``: the job keeps the answer in the trace, reports the call
    or ends with it; ``nothing``: it goes past the guard, or the job allows it.
    """

    VIRTUAL = "virtual"
    PINNED = "pinned"
    RECORDED = "recorded"
    DETECTED = "detected"
    REFUSED = "refused"
    NOTHING = "nothing"


IS_SAFE = frozenset({Treatment.VIRTUAL, Treatment.PINNED})
"""With these, a run does the same again."""

_OF_MODE = {
    Mode.VIRTUAL: Treatment.VIRTUAL,
    Mode.RECORD: Treatment.RECORDED,
    Mode.WARN: Treatment.DETECTED,
    Mode.ERROR: Treatment.REFUSED,
    Mode.ALLOW: Treatment.NOTHING,
}


@dataclass(frozen=True, slots=True)
class Rule:
    """One kind of call. ``does`` says what the guard does where ``treatment`` applies."""

    kind: str
    treatment: Treatment
    does: str
    instead: str
    source: Source | None = None
    """The key of ``guard:`` that governs it, if any does."""
    is_class: bool = False
    """Naming it is harmless; calling it or deriving from it is not."""

    def treated(self, policy: Policy | None, whose: str = "the job") -> tuple[Treatment, str]:
        """Return what a guard with this policy (None: no guard at all) does about the call."""
        if policy is None:
            return Treatment.NOTHING, "the job has no guard"
        if self.source is None or self.treatment not in (Treatment.VIRTUAL, Treatment.DETECTED):
            return self.treatment, self.does
        mode = policy.modes[self.source]
        if self.treatment is Treatment.DETECTED and mode is Mode.VIRTUAL:
            mode = Mode.WARN
        treatment = _OF_MODE[mode]
        if treatment is self.treatment:
            return treatment, self.does
        return treatment, f"{whose} says {self.source.value}: {mode.value}"


@dataclass(frozen=True, slots=True, order=True)
class Found:
    """One place in a source file; lines and columns count from 1, as editors do."""

    path: Path
    line: int
    column: int
    kind: str
    call: str
    treatment: Treatment
    does: str
    instead: str


@dataclass(frozen=True, slots=True)
class Audit:
    """All that was found, and what could not be looked at."""

    found: tuple[Found, ...]
    files: int
    troubles: tuple[str, ...] = ()
    """Files that cannot be read as Python: nothing is known of them."""
    notes: tuple[str, ...] = ()
    allowed: int = 0
    """Places that a comment silences."""


_V, _P, _D, _N = Treatment.VIRTUAL, Treatment.PINNED, Treatment.DETECTED, Treatment.NOTHING

_CLOCK = Rule("clock", _V, "shows simulated time", "self.get_clock().now()", source=Source.CLOCK)
_CPU_TIME = Rule(
    "clock", _D, "a finding of the run", "leave it to a profiler outside", source=Source.CLOCK
)
_SLEEP = Rule("sleep", _V, "waits in simulated time", "a timer: self.create_timer(seconds, …)")
_SHARED = "a generator with a seed of its own: random.Random(seed), from a parameter"
_RANDOM = Rule("random", _V, "draws from the node's seeded stream", _SHARED, source=Source.RANDOM)
_NUMPY = Rule(
    "random",
    _V,
    "draws from the node's seeded stream",
    "np.random.default_rng(seed), the seed from a parameter",
    source=Source.RANDOM,
)
_UNSEEDED = Rule(
    "random",
    _V,
    "is seeded from the node's stream",
    "give it a seed, from a parameter",
    source=Source.RANDOM,
)
_TORCH = Rule(
    "random",
    _V,
    "is seeded with the job's seed, if torch is loaded when the run begins",
    "a torch.Generator with a seed of its own",
    source=Source.RANDOM,
)
_ENTROPY = Rule(
    "random",
    _V,
    "comes from the node's seeded stream",
    "a counter, or bytes of a seeded generator",
    source=Source.RANDOM,
)
_THREAD = Rule(
    "thread",
    _V,
    "runs as a cooperative thread in simulated time",
    "timers, tasks or callback groups",
)
_SIGNAL = Rule(
    "thread", _D, "a finding of the run", "a timer: self.create_timer(…)", source=Source.THREAD
)
_PROCESS = Rule(
    "process",
    _D,
    "a finding of the run; it runs in real time",
    "do it before the run, or put it outside and record what it sends into a bag",
    source=Source.PROCESS,
)
_SOCKET = Rule(
    "socket",
    _D,
    "a finding of the run; answers come in real time",
    "record what comes from outside into a bag, or write 'socket: record' below 'guard:'",
    source=Source.SOCKET,
)
_DEVICE = Rule(
    "socket",
    _N,
    "read by a library in C, past the guard",
    "a driver node outside; record its topics into a bag",
)
_BLOCKING = Rule(
    "blocking", _N, "blocks the whole run in real time", "a topic, a service or a parameter"
)
_TERMINAL = Rule(
    "blocking",
    _V,
    "reads what the job says in stdin: (without it, that is an error)",
    "a topic, a service or a parameter",
)
STANDS_STILL = Rule(
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
_LISTING = Rule("directory", _V, "is sorted", "sorted(…)", source=Source.DIRECTORY)
_ENVIRONMENT = Rule(
    "environment", _D, "a finding of the run", "a parameter of the node", source=Source.ENVIRONMENT
)
_PID = Rule(
    "pid",
    _V,
    "is a number of the main's own, the same in every run",
    "a parameter of the node",
    source=Source.PID,
)
_PROCESSORS = Rule(
    "environment", _V, "is 4, on every machine", "a parameter of the node, or a number of your own"
)
_FILE_TIME = Rule(
    "file", _D, "a finding of the run", "what is in the file instead of its age", source=Source.FILE
)
_LOCALE = Rule(
    "locale", _P, "record runs in C.UTF-8", "plain formatting: f'{x:.3f}', key=str.casefold"
)
_SET_LOCALE = Rule(
    "locale", _N, "undoes what record has pinned", "plain formatting; leave the locale alone"
)
_ZONE = Rule("locale", _P, "record runs in UTC", "give the time zone: tz=timezone.utc")
_FINALIZER = Rule(
    "finalizer",
    _P,
    "garbage is collected between events only",
    "destroy_node(), close() or a with block",
)
_COLLECTOR = Rule(
    "finalizer", _N, "makes finalizers run amid callbacks", "leave the collector to the run"
)

ORDER = Rule(
    "order",
    _V,
    "its order is the same in every run; objects that hold the same are a finding",
    "sorted(…), or a dict or a list instead of the set",
    source=Source.ORDER,
)
ADDRESS = Rule(
    "address",
    _D,
    "a finding of the run",
    "a name or a number of your own",
    source=Source.ADDRESS,
)
HASH = Rule(
    "address",
    _D,
    "strings: the hash seed is pinned; addresses: a finding of the run",
    "zlib.crc32(text.encode()), or a key of your own",
    source=Source.ADDRESS,
)
EXCHANGED = Rule(
    "replaced",
    _D,
    "a note of the run: it is never called, because rsltrace runs callbacks itself",
    "exchange rclpy.executors.await_or_execute, or wrap the callbacks",
)
ENVIRON = _ENVIRONMENT
LOCALE_FORMAT = _LOCALE
DEL = _FINALIZER
SQL_CLOCK = Rule(
    "clock", _D, "a finding of the run", "pass the node's time as a parameter", source=Source.CLOCK
)

Condition = Callable[[ast.Call], bool]


def _none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def unseeded(call: ast.Call) -> bool:
    """Whether a generator is made without a seed."""
    if any(isinstance(argument, ast.Starred) for argument in call.args):
        return False
    seeds = [*call.args[:1], *(word.value for word in call.keywords)]
    return not seeds or all(map(_none, seeds))


def _fewer_than(count: int) -> Condition:
    def condition(call: ast.Call) -> bool:
        starred = any(isinstance(argument, ast.Starred) for argument in call.args)
        given = [argument for argument in call.args if not _none(argument)]
        return not starred and len(given) + len(call.keywords) < count

    return condition


def _with_callback(call: ast.Call) -> bool:
    return len(call.args) > 1


def _now_text(call: ast.Call) -> bool:
    first = call.args[0] if call.args else None
    return isinstance(first, ast.Constant) and first.value in ("now", "today")


def _from_environment(call: ast.Call) -> bool:
    second = call.args[1] if len(call.args) > 1 else None
    return isinstance(second, ast.Constant) and second.value == ""


def _named(rule: Rule, module: str, names: str) -> dict[str, Rule]:
    return {f"{module}.{name}": rule for name in names.split()}


def _class(rule: Rule) -> Rule:
    return Rule(rule.kind, rule.treatment, rule.does, rule.instead, rule.source, is_class=True)


_T = "time monotonic perf_counter process_time thread_time"
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
_SPAWNS = "spawnl spawnle spawnlp spawnlpe spawnv spawnve spawnvp spawnvpe"
_EXECS = "execl execle execlp execlpe execv execve execvp execvpe"
_REQUESTS = "get post put patch delete head options request Session"

RULES: dict[str, Rule] = {
    **_named(_CLOCK, "time", f"{_T} " + " ".join(f"{name}_ns" for name in _T.split())),
    **_named(_CLOCK, "time", "clock_gettime clock_gettime_ns localtime gmtime ctime asctime"),
    **_named(_CLOCK, "time", "strftime"),
    **_named(_CLOCK, "datetime.datetime", "now utcnow today"),
    **_named(_CLOCK, "datetime.date", "today"),
    **_named(_CLOCK, "timeit", "default_timer"),
    **_named(_CLOCK, "email.utils", "localtime formatdate"),
    **_named(_CLOCK, "numpy", "datetime64"),
    **_named(_CPU_TIME, "os", "times"),
    **_named(_CPU_TIME, "resource", "getrusage"),
    **_named(_SLEEP, "time", "sleep"),
    **_named(_RANDOM, "random", _DRAWS),
    **_named(_class(_UNSEEDED), "random", "Random"),
    **_named(_class(_ENTROPY), "random", "SystemRandom"),
    **_named(_RANDOM, "random", "seed"),
    **_named(_NUMPY, "numpy.random", f"{_NUMPY_DRAWS} seed"),
    **_named(_UNSEEDED, "numpy.random", "default_rng"),
    **_named(
        _class(_UNSEEDED),
        "numpy.random",
        "RandomState SeedSequence PCG64 PCG64DXSM MT19937 Philox SFC64",
    ),
    **_named(_ENTROPY, "os", "urandom getrandom"),
    **_named(_ENTROPY, "uuid", "uuid1 uuid4 getnode"),
    **_named(_ENTROPY, "secrets", "choice randbelow randbits token_bytes token_hex token_urlsafe"),
    **_named(_ENTROPY, "tempfile", "mktemp mkstemp mkdtemp"),
    **_named(_class(_ENTROPY), "tempfile", "NamedTemporaryFile TemporaryDirectory"),
    **_named(
        _TORCH,
        "torch",
        "rand randn randint randperm normal rand_like randn_like randint_like bernoulli "
        "multinomial poisson",
    ),
    **_named(_class(_THREAD), "threading", "Thread Timer"),
    **_named(_THREAD, "_thread", "start_new_thread"),
    **_named(_class(_THREAD), "concurrent.futures", "ThreadPoolExecutor"),
    **_named(_class(_THREAD), "concurrent.futures.thread", "ThreadPoolExecutor"),
    **_named(_class(_THREAD), "multiprocessing.pool", "ThreadPool"),
    **_named(_SIGNAL, "signal", "alarm setitimer"),
    **_named(
        _PROCESS,
        "subprocess",
        "run call check_call check_output getoutput getstatusoutput",
    ),
    **_named(_class(_PROCESS), "subprocess", "Popen"),
    **_named(
        _PROCESS,
        "os",
        f"system popen fork forkpty posix_spawn posix_spawnp {_SPAWNS} {_EXECS}",
    ),
    **_named(_class(_PROCESS), "multiprocessing", "Process Pool"),
    **_named(_class(_PROCESS), "multiprocessing.pool", "Pool"),
    **_named(_class(_PROCESS), "concurrent.futures", "ProcessPoolExecutor"),
    **_named(_PROCESS, "asyncio", "create_subprocess_exec create_subprocess_shell"),
    **_named(_PROCESS, "pty", "spawn fork"),
    **_named(_class(_SOCKET), "socket", "socket"),
    **_named(_SOCKET, "socket", "create_connection create_server getaddrinfo gethostbyname"),
    **_named(_SOCKET, "urllib.request", "urlopen urlretrieve"),
    **_named(_class(_SOCKET), "http.client", "HTTPConnection HTTPSConnection"),
    **_named(_class(_SOCKET), "http.server", "HTTPServer ThreadingHTTPServer"),
    **_named(_class(_SOCKET), "socketserver", "TCPServer UDPServer"),
    **_named(_class(_SOCKET), "ftplib", "FTP FTP_TLS"),
    **_named(_class(_SOCKET), "smtplib", "SMTP SMTP_SSL"),
    **_named(_class(_SOCKET), "xmlrpc.client", "ServerProxy"),
    **_named(_SOCKET, "requests", _REQUESTS),
    **_named(_SOCKET, "httpx", f"{_REQUESTS} Client AsyncClient stream"),
    **_named(_class(_SOCKET), "aiohttp", "ClientSession"),
    **_named(_SOCKET, "websockets", "connect serve"),
    **_named(_SOCKET, "asyncio", "open_connection start_server"),
    **_named(_class(_SOCKET), "paho.mqtt.client", "Client"),
    **_named(_class(_DEVICE), "zmq", "Context"),
    **_named(_class(_DEVICE), "serial", "Serial"),
    **_named(_class(_DEVICE), "cv2", "VideoCapture"),
    **_named(_DEVICE, "grpc", "insecure_channel secure_channel"),
    **_named(_TERMINAL, "builtins", "input"),
    **_named(_BLOCKING, "getpass", "getpass"),
    **_named(_TERMINAL, "sys.stdin", "read readline readlines"),
    **_named(_BLOCKING, "select", "select poll epoll"),
    **_named(_BLOCKING, "signal", "pause sigwait sigwaitinfo sigtimedwait"),
    **_named(_BLOCKING, "os", "wait waitpid wait3 wait4"),
    **_named(_BLOCKING, "fcntl", "flock lockf"),
    **_named(_ASYNC_IO, "asyncio", "run"),
    **_named(_LISTING, "os", "listdir scandir walk fwalk"),
    **_named(_LISTING, "glob", "glob iglob"),
    **_named(
        _ENVIRONMENT,
        "os",
        "getenv getenvb getppid uname getcwd getlogin getloadavg",
    ),
    **_named(_PROCESSORS, "os", "cpu_count process_cpu_count sched_getaffinity"),
    **_named(_PID, "os", "getpid"),
    **_named(_ENVIRONMENT, "os.path", "expanduser expandvars"),
    **_named(_ENVIRONMENT, "pathlib.Path", "cwd home"),
    **_named(_ENVIRONMENT, "platform", "node uname platform machine processor release version"),
    **_named(_ENVIRONMENT, "socket", "gethostname getfqdn"),
    **_named(_ENVIRONMENT, "getpass", "getuser"),
    **_named(_PROCESSORS, "multiprocessing", "cpu_count"),
    **_named(
        _ENVIRONMENT,
        "psutil",
        "cpu_percent cpu_times cpu_freq virtual_memory swap_memory disk_usage net_io_counters "
        "sensors_temperatures boot_time pids process_iter Process",
    ),
    **_named(_FILE_TIME, "os.path", "getmtime getatime getctime"),
    **_named(
        _LOCALE,
        "locale",
        "getlocale getdefaultlocale getpreferredencoding localeconv format_string currency str "
        "strcoll strxfrm nl_langinfo",
    ),
    **_named(_SET_LOCALE, "locale", "setlocale"),
    **_named(_ZONE, "datetime.datetime", "fromtimestamp"),
    **_named(_ZONE, "time", "mktime tzname timezone altzone"),
    **_named(_FINALIZER, "weakref", "ref proxy finalize"),
    **_named(_COLLECTOR, "gc", "enable set_threshold"),
}

CONDITIONS: dict[str, Condition] = {
    **dict.fromkeys(("time.localtime", "time.gmtime", "time.ctime"), _fewer_than(1)),
    "time.asctime": _fewer_than(1),
    "time.strftime": _fewer_than(2),
    "email.utils.localtime": _fewer_than(1),
    "email.utils.formatdate": _fewer_than(1),
    "numpy.datetime64": _now_text,
    **dict.fromkeys(
        (
            "random.Random",
            "random.seed",
            "numpy.random.seed",
            "numpy.random.default_rng",
            *(
                f"numpy.random.{name}"
                for name in "RandomState SeedSequence PCG64 PCG64DXSM MT19937 Philox SFC64".split()
            ),
        ),
        unseeded,
    ),
    "datetime.datetime.fromtimestamp": _fewer_than(2),
    "locale.setlocale": _from_environment,
    "weakref.ref": _with_callback,
    "weakref.proxy": _with_callback,
}
"""For some calls it depends on the arguments whether they mean now, or chance."""

SHARED = (_RANDOM, _NUMPY)
SEEDED_BY = {"random.": "random.seed", "numpy.random.": "numpy.random.seed"}
"""A module that seeds the shared generator itself may draw from it."""

METHODS = {"iterdir": _LISTING, "rglob": _LISTING}
"""Methods that say what they do by their names alone, whatever they are called on."""


def rule_of(name: str) -> Rule | None:
    """Return the rule for a function or class by its full name."""
    return RULES.get(name)


def allowed(module: str, globs: tuple[str, ...]) -> bool:
    """Return whether a job exempts a module from a source."""
    return any(fnmatchcase(module, glob) for glob in globs)
