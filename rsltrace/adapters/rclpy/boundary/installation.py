"""How the simulated middleware gets behind rclpy, and away again.

The reference ``_rclpy`` is replaced in every loaded rclpy module and in
``rclpy.impl.implementation_singleton`` (for modules that load later), and afterwards put back.
Where rclpy's extension is not loaded, its modules have the boundary from the beginning.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache, wraps
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec
from operator import attrgetter
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn, cast

import numpy as np

from rsltrace.adapters.rclpy import boundary as package
from rsltrace.adapters.rclpy.boundary.boundary import HANDLES, RclpyBoundary
from rsltrace.adapters.rclpy.boundary.extension import NAME
from rsltrace.errors import SetupError, UnsupportedError
from rsltrace.guard.guard import engage
from rsltrace.guard.redirect import replace_attribute

# rclpy's logger finds its caller with ``inspect.getframeinfo``, which reads source files, and
# ``os.path.realpath``: half a millisecond per record. Here that is done once per source file. What
# it finds (and so what ``once``, ``skip_first`` and throttles go by) is the same.

_FIELDS = ("function_name", "file_path", "line_number", "last_index")


@contextmanager
def quick_log_callers() -> Iterator[None]:
    """Let rclpy's logger find its callers quickly within the ``with`` block."""
    from rclpy.impl import rcutils_logger

    logger: Any = rcutils_logger
    with ExitStack() as stack:
        if getattr(logger.CallerId, "_fields", None) == _FIELDS:  # else: an unknown release
            quick = _log_callers_quick(logger, logger.CallerId)
            replace_attribute(stack, logger, "CallerId", quick)
        yield


@contextmanager
def eager_throttles() -> Iterator[None]:
    """Let a throttle log the first record within the ``with`` block, as in a native run, where
    clocks that show no simulation time are far from 0."""
    from rclpy.impl import rcutils_logger

    real: Any = rcutils_logger.Throttle

    class Throttle(real):  # type: ignore[misc]
        @classmethod
        def initialize_context(cls, context: Any, **options: Any) -> None:
            super().initialize_context(context, **options)
            if not getattr(context["throttle_time_source_type"], "ros_time_is_active", False):
                context["throttle_last_logged"] = -math.inf

    filters: Any = rcutils_logger.supported_filters
    filters["throttle"] = Throttle
    try:
        yield
    finally:
        filters["throttle"] = real


def _log_callers_quick(logger: Any, real: Any) -> Any:
    """Return a ``CallerId`` that does what ``real`` does and remembers the paths of files."""
    internal: list[str] = []
    """rclpy's list of its own files when ``places`` was made; user code may extend it."""
    places: dict[str, str | None] = {}
    """Absolute paths by the names in code objects; None for files of rclpy's logging."""
    make = tuple.__new__

    def place_of(frame: FrameType) -> str | None:
        with engage(None):  # the logger's look at source files is no finding
            path = os.path.abspath(inspect.getframeinfo(frame).filename)
            is_internal = logger._find_caller(frame) is not frame
        return None if is_internal else path

    class CallerId(real):  # type: ignore[misc]
        __slots__ = ()

        def __new__(cls, frame: FrameType | None = None) -> Any:
            if frame:
                return super().__new__(cls, frame)
            if logger._internal_callers != internal:
                places.clear()
                internal[:] = logger._internal_callers
            above: FrameType | None = sys._getframe(1)
            while above is not None:
                code = above.f_code
                file = code.co_filename
                try:
                    place = places[file]
                except KeyError:
                    place = place_of(above)
                    if os.path.isabs(file):  # others depend on the working directory
                        places[file] = place
                if place is not None:
                    return make(cls, (code.co_name, place, above.f_lineno, above.f_lasti))
                above = above.f_back
            return super().__new__(cls)  # which says what is wrong

    return CallerId


# rclpy's action server formats a goal's id (sixteen octets) five times per goal, for debug records.
# numpy takes 50 µs for each; the same text is made here in 5, and then kept.

_OCTETS = 16
_OCTET = np.dtype(np.uint8)
_LINE_MIN = 75
"""numpy's line width unless the user has set another: such a text fits into it."""
_OLD_STYLE = 113
"""Up to this number, numpy's option ``legacy`` means the style of 1.13."""


@contextmanager
def quick_id_texts() -> Iterator[None]:
    """Format arrays of sixteen octets quickly within the ``with`` block."""
    arrayprint: Any = sys.modules.get("numpy._core.arrayprint")
    keywords = getattr(getattr(arrayprint, "_default_array_str", None), "keywords", {})
    if "array2string" not in keywords or not hasattr(arrayprint, "format_options"):
        yield  # another numpy, which has it elsewhere
        return
    real, current_options = keywords["array2string"], arrayprint.format_options.get

    def array2string(a: Any, *arguments: Any) -> Any:
        if type(a) is np.ndarray and a.dtype is _OCTET and a.shape == (_OCTETS,):
            options = current_options()
            if (
                options["formatter"] is None
                and options["linewidth"] >= _LINE_MIN
                and options["threshold"] >= _OCTETS
                and options["legacy"] > _OLD_STYLE
            ):
                return octets_text(a.tobytes())
        return real(a, *arguments)

    keywords["array2string"] = array2string  # what ``str`` calls, with the options of now
    try:
        yield
    finally:
        keywords["array2string"] = real


@lru_cache(maxsize=16)
def octets_text(octets: bytes) -> str:
    """Return the text that ``str`` gives for an array of octets that fits into a line."""
    words = [str(octet) for octet in octets]
    width = max(map(len, words))
    return f"[{' '.join([word.rjust(width) for word in words])}]"


# Messages need one function of ``rosidl_generator_py``. The rest of that package, a code generator
# with a template engine and an IDL parser, is loaded only on demand: it takes a tenth of a short
# command's time, would be compiled as a node's library in a run, and gives deprecation warnings,
# which ``pytest -W error`` makes a node's failure.

_PACKAGE = "rosidl_generator_py"
_LOADER = "import_type_support"


def load_type_support(*, compiled: bool = True) -> None:
    """Load what messages need, before the run; it may be missing where nothing needs it.

    Without ``compiled`` type support, messages get a stand-in for it, which nothing calls.
    """
    with warnings.catch_warnings(), suppress(ImportError):
        warnings.simplefilter("ignore")
        importlib.import_module("rosidl_parser")
        if _PACKAGE not in sys.modules:
            spec = find_spec(_PACKAGE)
            if spec is not None and spec.submodule_search_locations:
                _load_in_part(spec)
        if not compiled:
            setattr(sys.modules[_PACKAGE], _LOADER, NotCompiled)


class NotCompiled:
    """Stands in for the compiled type support of a package."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> NotCompiled:
        if name.startswith("__"):
            raise AttributeError(name)
        return NotCompiled(f"{self._name}.{name}")

    def __call__(self, *arguments: object) -> NoReturn:
        raise RuntimeError(f"{self._name} is not compiled, or a simulation does not load it")


def _load_in_part(spec: ModuleSpec) -> None:
    """Load the package with its one function, the rest on demand."""
    package = sys.modules[_PACKAGE] = module_from_spec(spec)
    try:
        function = getattr(importlib.import_module(f"{_PACKAGE}.{_LOADER}_impl"), _LOADER)
    except (ImportError, AttributeError):  # not as the releases that we know
        _load_fully(package, spec)
        return
    setattr(package, _LOADER, function)

    def missing(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {_PACKAGE!r} has no attribute {name!r}")
        _load_fully(package, spec)
        return getattr(package, name)

    package.__dict__["__getattr__"] = missing


def _load_fully(package: ModuleType, spec: ModuleSpec) -> None:
    package.__dict__.pop("__getattr__", None)
    assert spec.loader is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spec.loader.exec_module(package)


# ``Publisher.publish`` puts a ``with`` around each message so that the C publisher is not freed
# meanwhile, which took a twelfth of an event. There is no C publisher here.

_NAMES = {"handle", "msg_type", "_Publisher__publisher", "publish", "publish_raw"}
"""What rclpy's own method looks up; if a release's method does not, it is not replaced."""


@contextmanager
def quick_publish() -> Iterator[None]:
    """Let rclpy's publishers publish quickly within the ``with`` block."""
    from rclpy.publisher import Publisher

    kind: Any = Publisher
    real = kind.publish
    if not set(getattr(getattr(real, "__code__", None), "co_names", ())) >= _NAMES:
        yield  # replaced by user code, or an unknown release
        return
    kind.publish = ours = _quick(real)
    try:
        yield
    finally:
        if kind.publish is ours:
            kind.publish = real


def _quick(real: Callable[[Any, Any], None]) -> Any:
    """Return a method that does what ``real`` does, and calls it for errors."""

    @wraps(real)
    def publish(self: Any, msg: Any) -> None:
        handle = self._Publisher__publisher
        try:
            is_ours = not handle.destroyed
        except AttributeError:
            is_ours = False  # one over DDS, in another thread of this process
        if is_ours:
            if isinstance(msg, self.msg_type):
                handle.publish(msg)
                return
            if isinstance(msg, bytes):
                handle.publish_raw(msg)
                return
        real(self, msg)

    return publish


@contextmanager
def callback_as_attribute() -> Iterator[None]:
    """Let subscriptions have ``_callback`` within the ``with`` block, as they have from Iron on."""
    from rclpy.subscription import Subscription

    with ExitStack() as stack:
        if not hasattr(Subscription, "callback"):
            Subscription._callback = property(attrgetter("callback"))
            stack.callback(delattr, Subscription, "_callback")
        yield


# Each release of ROS 2 adds a few names to the extension. If rclpy's Python code uses one that is
# missing here, the run is refused before it starts.

KNOWN = "Humble (rclpy 3.3), Jazzy (7.1) and Kilted (9.1)"
_USED = re.compile(rb"_rclpy\.([A-Za-z]\w*)")
_DECLARED = re.compile(r"^(?:class (?P<kind>\w+)|    def (?P<method>[A-Za-z]\w*)\()", re.MULTILINE)
_UNUSED = {"add_to_waitset"}  # executors get no wait set here


def check_release(replacement: Any, handles: Mapping[str, type], package: Path) -> None:
    """Raise SetupError if rclpy uses a name of its extension that is missing in ``replacement``.

    ``handles`` are the classes of the objects that it makes, by their names in the extension;
    ``package`` is the folder of rclpy's sources.
    """
    missing = missing_parts(replacement, handles, package)
    if missing:
        raise SetupError(
            f"this version of rsltrace cannot simulate the rclpy in {package}: it uses "
            f"{', '.join(missing)} of its C extension. rsltrace works with {KNOWN}: "
            "update rsltrace, source one of these, or install the wheels into a separate "
            "environment: pip install 'rsltrace[ros]'"
        )


def missing_parts(replacement: Any, handles: Mapping[str, type], package: Path) -> list[str]:
    """Return the names of the extension that rclpy's sources use and that are missing, sorted."""
    # The first only has an example; handles refuse the second, nodes on asyncio, by name.
    files = set(package.rglob("*.py")) - {package / "impl" / "implementation_singleton.py"}
    files.difference_update((package / "experimental").rglob("*.py"))
    sources = b"\n".join(path.read_bytes() for path in files)
    names = set()
    for found in _USED.finditer(sources):
        before = sources[sources.rfind(b"\n", 0, found.start()) + 1 : found.start()]
        if b"#" not in before and before[-1:] not in (b"'", b'"', b"["):  # texts for type checkers
            names.add(found[1].decode())
    missing = [name for name in names if not hasattr(replacement, name)]
    for kind, method in _methods(getattr(replacement, "real", None), package):
        handle = handles.get(kind)
        if handle is None or method in _UNUSED or hasattr(handle, method):
            continue
        if f".{method}(".encode() in sources:
            missing.append(f"{kind}.{method}")
    return sorted(missing)


def _methods(real: Any, package: Path) -> Iterator[tuple[str, str]]:
    """Yield the classes of the extension with their methods: of the extension itself, or as its
    stub file declares them, which rclpy has since Kilted."""
    if real is not None:
        for kind, of in vars(real).items():
            yield from ((kind, method) for method in getattr(of, "__dict__", ()))
        return
    stub = package / "impl" / "_rclpy_pybind11.pyi"
    kind = ""
    for found in _DECLARED.finditer(stub.read_text("utf-8") if stub.is_file() else ""):
        kind = found["kind"] or kind
        if found["method"]:
            yield kind, found["method"]


_installed: RclpyBoundary | None = None


def boundary() -> RclpyBoundary:
    """Return the boundary; rclpy's modules bind it, or its extension if that is loaded.

    :raises SetupError: if rclpy is not installed or cannot be simulated.
    """
    global _installed
    if _installed is None:
        if "t" in getattr(sys, "abiflags", ""):
            raise SetupError(
                "rsltrace cannot run nodes on a free-threaded build of Python, where threads "
                "run at once: use the ordinary build of the same version"
            )
        ours = RclpyBoundary(_extension())
        if ours.real is None:
            sys.modules[NAME] = cast(ModuleType, ours)
        try:
            from rclpy.impl import implementation_singleton as singleton
        except ImportError as error:
            sys.modules.pop(NAME, None)
            raise SetupError(
                "rclpy is not installed for this Python: install the ROS wheels with "
                "`pip install 'rsltrace[ros]'`, or source a ROS 2 installation; `rsltrace "
                f"install-ros` is for machines that have neither ({error})"
            ) from error
        load_type_support(compiled=ours.real is not None)
        check_release(ours, HANDLES, Path(singleton.__file__).parents[1])
        _installed = ours
    return _installed


def _extension() -> Any | None:
    """Return rclpy's C extension; None if nothing needs it, or it cannot be loaded."""
    if not (package.loads_extension or NAME in sys.modules):
        return None
    try:
        from rclpy.impl.implementation_singleton import rclpy_implementation
    except ImportError:
        for name in [name for name in sys.modules if name.partition(".")[0] == "rclpy"]:
            del sys.modules[name]
        return None
    return rclpy_implementation


def native_extension() -> Any:
    """Return rclpy's C extension, for a native run.

    :raises SetupError: if it is absent.
    """
    package.loads_extension = True
    real = boundary().real
    if real is None:
        raise SetupError(
            "a native run needs the compiled parts of ROS 2, which are not installed for this "
            "Python: install the ROS wheels with `pip install 'rsltrace[ros]'`, or source a ROS 2 "
            "installation"
        )
    return real


def check_no_simulation() -> None:
    """Raise UnsupportedError if a simulation is running in this process.

    :raises SetupError: if rclpy is not installed or cannot be loaded.
    """
    if not boundary().is_free:
        raise UnsupportedError(
            "another simulation is running in this process: leave its Simulation block first, or "
            "use another process"
        )


@contextmanager
def installed() -> Iterator[RclpyBoundary]:
    """Let rclpy use the simulated middleware within the ``with`` block."""
    ours = boundary()
    _bind(ours)
    try:
        with ExitStack() as stack:
            for change in (
                quick_log_callers,
                eager_throttles,
                quick_id_texts,
                quick_publish,
                callback_as_attribute,
            ):
                stack.enter_context(change())
            yield ours
    finally:
        _bind(ours.real or ours)


def _bind(new: Any) -> None:
    """Let rclpy's modules use the boundary, or its extension."""
    ours = boundary()
    old = ours if new is ours.real else ours.real
    for module in list(sys.modules.values()) if ours.real is not None else ():
        names = getattr(module, "__dict__", None)
        if not isinstance(names, dict) or module is sys.modules[__name__]:
            continue
        for name in ("_rclpy", "rclpy_implementation"):
            if names.get(name) is old:
                names[name] = new
    logger = sys.modules.get("rclpy.impl.rcutils_logger")
    if logger is not None:
        # The default clock of throttled logging was made when the module was loaded.
        from rclpy.clock import Clock

        logger.Throttle.params["throttle_time_source_type"] = Clock()
