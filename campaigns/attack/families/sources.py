"""Nondeterministic nodes: each publishes what one source says, used in one way, at random.

A job of some of them is recorded twice in unlike environments. A node that published something
else must have a finding that names it; without one, the difference was silent.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from random import Random

from campaigns.attack import oracle
from campaigns.attack.corpus import Corpus
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong
from rsltrace.trace.model.finding import GuardCount, NondeterminismSource
from rsltrace.trace.reader import Trace

_SOURCES: dict[str, str] = {
    "clocks": """
        time.time()
        time.time_ns()
        time.perf_counter()
        time.monotonic_ns()
        time.process_time_ns()
        time.thread_time()
        time.clock_gettime(time.CLOCK_BOOTTIME)
        time.strftime('%H:%M:%S %Z')
        time.localtime()[:6]
        time.ctime()
        datetime.datetime.now().isoformat()
        datetime.datetime.now(datetime.timezone.utc).timestamp()
        datetime.datetime.fromtimestamp(0).isoformat()
        datetime.date.today().isoformat()
        os.times().elapsed
        resource.getrusage(resource.RUSAGE_SELF).ru_utime
        email.utils.formatdate()
        timeit.default_timer()
        timeit.timeit('pass', number=10)
        uuid.uuid1().hex
        str(np.datetime64('now', 'ns'))
        logging.makeLogRecord({}).created
        asyncio.new_event_loop().time()
    """,
    "random": """
        random.random()
        random.Random().random()
        random.SystemRandom().random()
        random.sample(range(1000), 3)
        random.getstate()[1][:3]
        secrets.token_hex(4)
        os.urandom(4).hex()
        os.getrandom(4).hex()
        uuid.uuid4().hex
        ssl.RAND_bytes(4).hex()
        np.random.rand(2).tolist()
        np.random.default_rng().random()
        np.random.RandomState().rand()
        np.random.SeedSequence().entropy
        open('/dev/urandom', 'rb').read(4).hex()
        tempfile.mktemp()
        os.path.basename(tempfile.NamedTemporaryFile().name)
    """,
    "order": """
        list({'a', 'b', 'c', 'd'})
        str(frozenset(map(str, range(9))))
        {'x', 'y', 'z'}.pop()
        list(set('scan') | set('odom'))
        list(map(str, {1.5, 'a', None, (1, 'b')}))
        [o.n for o in {type('O', (), {'n': n})() for n in range(6)}]
        hash('scan')
        hash((1, 'a', b'c'))
        hash(datetime.date(2024, 1, 1))
        hash(None)
        hash(object())
        hash(len)
        hash(lambda: 0)
        hash(float('nan'))
        id(object()) % 4096
        repr(object())
        repr(lambda: 0)
        str(weakref.ref(self))
        sorted([object() for _ in range(3)], key=id)[0].__hash__()
        [n for n, _ in sorted(enumerate([[] for _ in range(9)]), key=lambda p: id(p[1]))]
        pickle.dumps({'a', 'b', 'c'}).hex()
        list(weakref.WeakSet([self, type(self), Node]))[0].__class__.__name__
        list({str: 1, int: 2, Node: 3}.keys() & {str, int, Node})
    """,
    "environment": """
        os.environ.get('HOME')
        list(os.environ)
        len(os.environ)
        os.getenv('USER')
        os.path.expanduser('~')
        os.path.expandvars('$ATTACK')
        getpass.getuser()
        os.getcwd()
        str(pathlib.Path.cwd())
        os.path.abspath('x')
        __file__
        inspect.getfile(type(self))
        ''.join(traceback.format_stack())
        sys.argv
        sys.path
        sys.flags.hash_randomization
        locale.getlocale()
        locale.getpreferredencoding()
        time.tzname
        time.timezone
        os.getpid()
        os.getppid()
        os.getpgrp()
        os.getsid(0)
        os.cpu_count()
        os.sched_getaffinity(0)
        os.getloadavg()
        platform.node()
        platform.platform()
        shutil.get_terminal_size()
        tempfile.gettempdir()
        resource.getrlimit(resource.RLIMIT_NOFILE)
        sysconfig.get_path('stdlib')
        os.uname().release
        os.nice(0)
    """,
    "files": """
        os.listdir('.')
        [p.name for p in pathlib.Path('.').iterdir()]
        glob.glob('*')
        [e.inode() for e in os.scandir('.')]
        next(os.walk('.'))[2]
        os.stat(__file__).st_mtime_ns
        os.stat(__file__).st_ino
        os.path.getctime(__file__)
        os.path.getsize('.')
        open('/proc/self/stat').read()
        open('/proc/uptime').read()
        open('/proc/meminfo').read()
        open('/proc/self/maps').readline()
        os.readlink('/proc/self')
        os.readlink('/proc/self/cwd')
        shutil.disk_usage('/').free
        os.statvfs('.').f_bfree
        open(__file__).fileno()
        os.dup(0)
        os.open(os.devnull, 0)
        linecache.getline('/proc/uptime', 1)
        pathlib.Path('/proc/loadavg').read_text()
        np.fromfile('/proc/uptime', dtype=np.uint8)[:4].tolist()
        open('note.txt').read()
        io.open_code('/proc/uptime').read(4)
        mmap.mmap(os.open(__file__, 0), 0, prot=1).size()
    """,
    "threads": """
        threading.get_ident()
        threading.get_native_id()
        threading.current_thread().name
        threading.active_count()
        race(lambda n: n)
        race(lambda n: [time.sleep(0.0001), n][1])
        race(lambda n: [sum(range(5000 * (5 - n))), n][1])
        completed(lambda n: n)
        completed(lambda n: [time.sleep(0.001 * (n % 2)), n][1])
        asyncio.run(gathered())
        subprocess.run(['date', '+%N'], capture_output=True).stdout
        subprocess.getoutput('echo $$')
        os.popen('echo $RANDOM $HOME').read()
        multiprocessing.current_process().pid
        multiprocessing.cpu_count()
        signal.getsignal(signal.SIGALRM)
        sys.getswitchinterval()
    """,
    "network": """
        socket.gethostname()
        socket.getfqdn()
        bound()
        socket.getaddrinfo('localhost', 80)
        socket.gethostbyname('localhost')
        socket.if_nameindex()
        [s.fileno() for s in socket.socketpair()]
        len(select.select(socket.socketpair(), [], [], 0)[0])
        uuid.getnode()
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM).getsockopt(socket.SOL_SOCKET, 8)
    """,
    "memory": """
        np.empty(8).tolist()
        np.empty((3, 3), dtype=np.float32).tobytes().hex()
        np.ndarray(6).tolist()
        np.zeros(3).ctypes.data
        np.zeros(3).__array_interface__['data'][0]
        ctypes.addressof(ctypes.create_string_buffer(8))
        array.array('b', [1]).buffer_info()[0]
        ctypes.CDLL(None).rand()
        ctypes.CDLL(None).time(None)
        ctypes.CDLL(None).getpid()
        ctypes.string_at(id(self), 8).hex()
        ctypes.c_uint64.from_address(id(self)).value
        sys.getrefcount(None)
        sys.getallocatedblocks()
        gc.get_count()
        len(gc.get_objects())
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        np.linalg.svd(np.arange(900.0).reshape(30, 30) % 7)[1][-1]
        float(np.dot(np.linspace(0, 1, 999), np.sin(np.arange(999))))
        sys.intern('a' * 9).__repr__.__self__ is 'a' * 9
        str(np.array([object()], dtype=object))
    """,
}
_USES = (
    "self.say({source})",
    "self.say(repr({source}))",
    "self.say(hash(str({source})) % 7)",
    "self.say(len(repr({source})))",
    "self.say(sorted([repr({source}), repr({source}), 'm']))",
    "[self.say(n) for n in range(int(md5({source}), 16) % 4)]",
    "self.say('odd') if int(md5({source}), 16) % 2 else None",
    "self.kept.append({source}); self.say(self.kept[-1])",
    "self.kept.append({source}); self.say(self.kept[0])",
    "self.say((lambda: {source})())",
    "self.say([{source} for _ in range(2)])",
    "self.say(f'{{{source}}}')",
    "threading.Thread(target=lambda: self.kept.append({source})).start(); self.say(self.kept[-1:])",
    "self.timer.timer_period_ns = 50_000_000 + int(md5({source}), 16) % 9 * 1_000_000; self.say(0)",
    "self.get_logger().info(str({source}))",
    "self.set_parameters([rclpy.Parameter('p', value=str({source}))]); self.say(0)",
)
_NODE = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
import array, asyncio, concurrent.futures, ctypes, datetime, email.utils, gc, getpass, glob
import hashlib, inspect, io, linecache, locale, logging, mmap, multiprocessing, os, pathlib, pickle
import platform, queue, random, resource, secrets, select, shutil, signal, socket, ssl, subprocess
import sys, sysconfig, tempfile, threading, time, timeit, traceback, uuid, weakref
import numpy as np

def md5(value):
    return hashlib.md5(repr(value).encode('utf-8', 'replace')).hexdigest()

def race(work):
    found = []
    threads = [threading.Thread(target=lambda n=n: found.append(work(n))) for n in range(5)]
    [one.start() for one in threads]
    [one.join() for one in threads]
    return found

def completed(work):
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        futures = [pool.submit(work, n) for n in range(5)]
        return [one.result() for one in concurrent.futures.as_completed(futures)]

async def gathered():
    found = []
    async def one(n):
        await asyncio.sleep(0.001 * (n % 2))
        found.append(n)
    await asyncio.gather(*map(one, range(5)))
    return found

def bound():
    with socket.socket() as one:
        one.bind(('127.0.0.1', 0))
        return one.getsockname()[1]

class Source(Node):
    def __init__(self):
        super().__init__({name!r})
        self.kept = []
        self.declare_parameter('p', '')
        self.out = self.create_publisher(String, {name!r}, 10)
        self.timer = self.create_timer(0.1, self.tick)
        {made}

    def say(self, value):
        self.out.publish(String(data=str(value)[:2000]))

    def tick(self):
        {ticks}
        pass
"""
_GUARDED = """try: {use}
        except Exception as error: self.say(type(error).__name__)"""
_LIMITS = Limits(cpu_s=40, rss_mib=900)


def _attack(group: str) -> Attack:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        folders = case.folder / "a", case.folder / "another-folder" / "b"
        nodes = {}
        for number in range(rng.randint(2, 5)):
            of = group if rng.random() < 0.8 else rng.choice(list(_SOURCES))
            source = rng.choice([line.strip() for line in _SOURCES[of].split("\n") if line.strip()])
            nodes[f"n{number}"] = rng.choice(_USES).format(source=source), rng.random() < 0.3
        for folder in folders:
            folder.mkdir(parents=True)
            for name, (use, in_constructor) in nodes.items():
                guarded = _GUARDED.format(use=use)
                made, ticks = (guarded, "") if in_constructor else ("", guarded)
                (folder / f"{name}.py").write_text(
                    _NODE.replace("{name!r}", repr(name))
                    .replace("{made}", made)
                    .replace("{ticks}", ticks)
                )
            lines = "".join(f"  - node: {name}:Source\n" for name in nodes)
            (folder / "job.yaml").write_text(f"nodes:\n{lines}stop: {{duration: 350ms}}\n")
        (folders[0] / "note.txt").write_text("one")
        (folders[1] / "note.txt").write_text("two")
        (folders[1] / f"more-{rng.random()}").write_text("")
        words = ("record", "job.yaml", "-o", "out.mcap", "-q")
        perturbed = (
            ("PYTHONHASHSEED", str(rng.randrange(1, 2**32))),
            ("HOME", str(folders[1])),
            ("USER", "somebody"),
            ("TZ", rng.choice(("Asia/Kathmandu", "America/St_Johns"))),
            ("LANG", "tr_TR.UTF-8"),
            ("TMPDIR", str(folders[1])),
            ("ATTACK", "x" * rng.randrange(1, 3000)),
        )
        for folder, environment, client in (
            (folders[0], (), None),
            (folders[1], perturbed, _keep_busy),
        ):
            case.commands.append(
                Command(
                    words,
                    oracle.RECORDING,
                    folder,
                    fresh=True,
                    limits=_LIMITS,
                    environment=environment,
                    client=client,
                )
            )
        case.user_code = True
        case.names = ("job.yaml", *nodes)
        case.note = "; ".join(f"{name}: {use}" for name, (use, _) in nodes.items())
        uses = {f"/{name}": use for name, (use, _) in nodes.items()}
        case.judge = lambda runs: _judge(folders, runs, uses)

    return attack


def _keep_busy(pid: int) -> None:
    """Be another load until a process has ended."""
    while Path(f"/proc/{pid}").exists():
        sum(range(200_000))
        os.sched_yield()


def _judge(folders: Sequence[Path], runs: Sequence[Ran], uses: dict[str, str]) -> list[Complaint]:
    line = runs[-1].line
    if len({ran.status for ran in runs}) > 1:
        text = f"statuses {[ran.status for ran in runs]}"
        return [Complaint(Wrong.ANSWER, text, line)]
    if runs[0].status == oracle.USAGE:
        return []
    with Trace.open(folders[0] / "out.mcap") as a, Trace.open(folders[1] / "out.mcap") as b:
        if a.digest == b.digest:
            return []
        named = {met.node for trace in (a, b) for met in trace.guarded if _is_said(met)}
        differing = [node for node in uses if _sent(a, node) != _sent(b, node)]
    found = [
        Complaint(Wrong.ANSWER, f"silent: {node}: {uses[node]}", line)
        for node in differing
        if node not in named
    ]
    if not differing and not named:
        found.append(Complaint(Wrong.ANSWER, "silent: the digests differ, no message does", line))
    return found


def _is_said(met: GuardCount) -> bool:
    """Whether a run says what may differ: a finding, or names of a folder, which are an input."""
    return met.is_finding or met.source is NondeterminismSource.DIRECTORY


def _sent(trace: Trace, node: str) -> list[tuple[int, int]]:
    """Return what a node has sent: when, and the hashes of it."""
    (number,) = [
        one.id for one in trace.entities.values() if one.name == node and one.id == one.node
    ]
    own = {one.id for one in trace.entities.values() if one.node == number}
    return [
        (trace.event(output.event).stamp_ns, output.hash)
        for index in range(trace.event_count)
        for output in trace.outputs_of(index)
        if output.entity in own
    ]


FAMILY = Family(
    "sources",
    {group: _attack(group) for group in _SOURCES},
    sliced=frozenset(("clocks", "order", "threads")),
    ros=True,
)
