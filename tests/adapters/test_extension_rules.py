"""rsltrace's rules for names, ROS arguments, parameters, QoS and log levels are those of rclpy's C
extension and of rcl, which are asked here for the same."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rsltrace.adapters.rclpy import arguments, names
from rsltrace.adapters.rclpy.arguments import LEVELS, LogLevels
from rsltrace.adapters.rclpy.boundary import extension
from rsltrace.adapters.rclpy.boundary.boundary import _TYPES
from rsltrace.adapters.rclpy.boundary.installation import boundary
from rsltrace.adapters.rclpy.handles.qos_profiles import compatibility
from tests.adapters import rcl_arguments

pytestmark = pytest.mark.ros


def real() -> Any:
    from rclpy.impl.implementation_singleton import rclpy_implementation

    return rclpy_implementation


def text_of(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a function returns, or the text of its error without the line in ROS's source."""
    try:
        return function(*arguments)
    except (ValueError, RuntimeError) as error:
        return f"error: {re.sub(r', at [^ ]+:[0-9]+', '', str(error))}"


# -- names -----------------------------------------------------------------------------------------

LONG = [
    f"{'/' * slashes}{'a' * length}" for slashes in (0, 1) for length in (*range(243, 257), 300)
]
NAMES = st.text(alphabet="ab_1/~{}n .é", max_size=9) | st.sampled_from(
    [*LONG, "{node}", "{ns}/x", "~/{node}", "~{ns}", "{namespace}x", "a{node}b{ns}", "~", "~/"]
)


@given(NAMES)
def test_names_have_the_faults_that_ros_finds(name: str) -> None:
    for theirs, ours in (
        ("topic_name", names.topic_fault),
        ("full_topic_name", names.full_topic_fault),
        ("namespace", names.namespace_fault),
        ("node_name", names.node_name_fault),
    ):
        assert ours(name) == getattr(real(), f"rclpy_get_validation_error_for_{theirs}")(name)


@given(NAMES, st.sampled_from(["n", "a_1", "_"]) | NAMES, st.sampled_from(["/", "/a/b_1"]) | NAMES)
def test_names_expand_as_in_ros(topic: str, node: str, namespace: str) -> None:
    parts = (topic, node, namespace)
    assert text_of(names.expand, *parts) == text_of(real().rclpy_expand_topic_name, *parts)


# -- arguments -------------------------------------------------------------------------------------

WORDS = (
    r"~/ rosservice:// rostopic:// := := : __node __name __ns \1 \7 a b_ _c __ _ 1 / / * ** . foo "
    r"rosto ros é ~ \ r __no __nod -p debug WARN info { 'x' [1,2] 1.5 true"
).split()
BROKEN = st.lists(st.sampled_from(WORDS), max_size=7).map("".join)
RULES = st.builds(
    "{}{}{}{}:={}{}".format,
    st.sampled_from(["", "n:", "m:"]),
    st.sampled_from(["", "rosservice://", "rostopic://"]),
    st.sampled_from(["", "~/", "/"]),
    st.sampled_from(["a", "a/b", "x_1"]),
    st.sampled_from(["", "~/", "/"]),
    st.sampled_from(["c", "d/e"]),
) | st.sampled_from(
    ["__ns:=/q", "n:__node:=zz", "__name:=k", "__ns:=/q/", "m:__ns:=/e/f", "__node:=n"]
)
FLAGS = "-p --param -r --remap -r -r --log-level -e --log-file-name --log-config-file".split()
ALONE = (
    "-- --ros-args --disable-rosout-logs --enable-stdout-logs --bogus x:=y -p -r --log-level "
    "--params-file --enclave"
).split()
ARGUMENTS = st.lists(
    st.tuples(st.sampled_from(FLAGS), BROKEN | RULES | RULES) | st.tuples(st.sampled_from(ALONE)),
    max_size=4,
).map(lambda groups: ["--ros-args", *(word for group in groups for word in group)])
TOPICS = ("/a", "/a/b", "/n/a", "/x_1", "/q/b/a", "/m/x_1")


def meaning(parse: Any, own: list[str], outer: list[str]) -> Any:
    """Return what arguments do, or the error that they are."""
    try:
        first = parse(own)
    except ValueError as error:
        return type(error).__name__, str(error)
    try:
        other = parse(outer)
    except ValueError:
        other = None
    found = []
    for name, space in (("n", "/"), ("m", "/a"), ("k", "/q/b")):
        found.append(text_of(first.remap_node_name, name, other))
        found.append(text_of(first.remap_namespace, space, name, other))
        found.append(first.parameters(f"{space.rstrip('/')}/{name}"))
        for topic in TOPICS:
            for is_service in (False, True):
                remap = partial(first.remap_topic, service=is_service)
                found.append(text_of(remap, topic, name, space, other))
    return found


@given(ARGUMENTS, ARGUMENTS)
def test_arguments_mean_what_they_mean_in_ros(own: list[str], outer: list[str]) -> None:
    ours = meaning(arguments.RosArguments, own, outer)
    assert repr(ours) == repr(meaning(rcl_arguments.RosArguments, own, outer))


def test_what_is_no_ros_argument_remains() -> None:
    words = ["a", "x:=y", "--ros-args", "-r", "x:=y", "--", "b", "--ros-args"]
    assert arguments.RosArguments(words).others == real().rclpy_remove_ros_args(words)
    assert arguments.RosArguments(words).others == ["a", "b"]
    for wrong in (["a", "--ros-args", "--x", "y"], ["--ros-args", "-r"], ["--ros-args", "-p", "1"]):
        ours = text_of(boundary().rclpy_remove_ros_args, wrong)
        assert ours == text_of(real().rclpy_remove_ros_args, wrong)


# -- parameters ------------------------------------------------------------------------------------

SCALARS = st.sampled_from(
    "1 -2 +3 0x1F 010 09 0 -0 00 1.5 1e3 1e400 1e-310 5e-324 4.9e-324 1e-400 0.0 -0.0 0e999 .5 5. "
    "+.5 .inf -.inf +.INF .NaN inf nan -inf Infinity nan(12) 0x1p3 0x1.8p-1074 0x1p-1080 0x 1_000 "
    "true Yes off y N null ~ abc 9223372036854775807 9223372036854775808 -9223372036854775808 "
    '-9223372036854775809 1e 1e+ e5 0b1 0o7 12abc \'1\' "true" "a\\n" é \'\' "" 2001-01-01 '
    "1.7976931348623157e308 2.2250738585072014e-308 2.2250738585072011e-308 0x1fffffffffffffffff "
    "-0x10 +0x10 *a [] {} #c".split()
) | st.sampled_from(["a b", "!!str 1", "!!int '5'", "!!float 1", " 7", "- 5", "&a 5", "|\n  x", ""])
NUMBERS = (
    st.integers().map(str)
    | st.floats().map(repr)
    | st.text(alphabet="0123456789.eE+-xXpPaf_ ", max_size=7)
)
ITEMS = st.lists(SCALARS | NUMBERS, max_size=3) | st.lists(
    st.sampled_from(["1", "2.0", "a", "'b'", "true", "[1]", "{a: 1}"]), max_size=4
)
VALUES = SCALARS | NUMBERS | ITEMS.map(lambda items: f"[{', '.join(items)}]")


@given(
    st.lists(
        st.tuples(st.sampled_from(["", "n:", "m:"]), st.sampled_from(["a", "a.b", "b/c"]), VALUES),
        min_size=1,
        max_size=3,
    )
)
def test_parameters_have_the_types_that_ros_finds(rules: list[tuple[str, str, str]]) -> None:
    words = ["--ros-args"]
    for node, name, value in rules:
        words += ["-p", f"{node}{name}:={value}"]
    ours = meaning(arguments.RosArguments, words, [])
    assert repr(ours) == repr(meaning(rcl_arguments.RosArguments, words, []))


KEYS = st.sampled_from(
    "n a /n /a/n /** /* ** * a/n /a /a/ /**/n /*/n /a//n 1x ros__parameters ros__parameters "
    "ros__parametersX b / //n a.b '' [1] p q".split()
)
IN_FILES = st.sampled_from(
    "1 2.5 x true 'q' [a,b] [1,a] [] {} [[1],[2]] [{b:1}] *x 1.5e400".split()
) | st.sampled_from(
    ["", "[1, 2]", "[{b: 1}]", "[{b: 1, c: 2}]", "&x 3", "!!str 5", "{b: {c: 1}}", "|\n        t"]
)
ANYTHING = st.recursive(
    IN_FILES, lambda inner: st.dictionaries(KEYS, inner, max_size=4), max_leaves=8
)
PARAMETERS = st.recursive(
    IN_FILES,
    lambda inner: st.dictionaries(st.sampled_from(["a", "b", "c", "a.b"]), inner, max_size=3),
    max_leaves=6,
)
OF_A_NODE = st.fixed_dictionaries({"ros__parameters": PARAMETERS})
FILES = st.dictionaries(
    st.sampled_from("n /n /a/n /** /* /**/n /*/n a m".split()),
    OF_A_NODE | st.dictionaries(st.sampled_from(["n", "b", "**"]), OF_A_NODE, max_size=2),
    max_size=4,
)
AROUND = st.sampled_from(
    ["", "", "", "---\n", "...\n", "%YAML 1.1\n---\n", "# c\n", "- a\n", "'\n"]
)


def yaml_text(content: Any, indent: int = 0) -> str:
    if isinstance(content, str):
        return f" {content}\n"
    if not content:
        return " {}\n"
    lines = [f"{' ' * indent}{key}:{yaml_text(each, indent + 2)}" for key, each in content.items()]
    return ("\n" if indent else "") + "".join(lines)


@given(
    st.lists(st.tuples(AROUND, ANYTHING | FILES | FILES, AROUND), min_size=1, max_size=2),
    st.sampled_from([[], ["-p", "n:a:=4"], ["-p", "b:=x"]]),
)
def test_parameter_files_are_read_as_by_ros(
    tmp_path_factory: pytest.TempPathFactory, contents: list[Any], between: list[str]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    words = ["--ros-args"]
    for number, (before, content, after) in enumerate(contents):
        path = folder / f"parameters_{number}.yaml"
        path.write_text(before + yaml_text(content) + after)
        words += ["--params-file", str(path), *between]
    ours = meaning(arguments.RosArguments, words, [])
    assert repr(ours) == repr(meaning(rcl_arguments.RosArguments, words, []))


def test_a_file_that_cannot_be_read_is_an_error_as_in_ros(tmp_path: Path) -> None:
    for path in (str(tmp_path), str(tmp_path / "none.yaml"), ""):
        words = ["--ros-args", "--params-file", path]
        ours = meaning(arguments.RosArguments, words, [])
        assert ours == meaning(rcl_arguments.RosArguments, words, [])
        assert ours[0] == "InvalidArgumentsError"


# -- QoS and log levels ----------------------------------------------------------------------------

LIMITS = st.sampled_from([0, 1, 5 * 10**9, 2**63 - 2, 2**63 - 1])
PROFILES = st.tuples(
    st.integers(0, 4), st.integers(0, 4), st.integers(0, 5), LIMITS | st.just(0), LIMITS
)


@settings(max_examples=100)
@given(PROFILES, PROFILES)
def test_profiles_are_compatible_where_ros_says_so(one: Any, other: Any) -> None:
    def profile(reliability: int, durability: int, liveliness: int, limit: int, lease: int) -> Any:
        span = real().rcl_duration_t
        values = (1, 10, reliability, durability, span(0), span(limit), liveliness, span(lease))
        return real().rmw_qos_profile_t(*values, False)

    theirs = real().rclpy_qos_check_compatible(profile(*one), profile(*other))
    ours = compatibility(profile(*one).to_dict(), profile(*other).to_dict())
    assert ours == (int(theirs.compatibility), theirs.reason)


LOGGERS = st.sampled_from(["", "a", "a.b", "a.b.c", "a.", "a..b", ".a", ".", "b", "a.b.d", "aa"])


@example([("", 0), ("a", None)])
@given(st.lists(st.tuples(LOGGERS, st.sampled_from([None, 0, 10, 20, 30, 40, 50, 15, -1, 60]))))
def test_loggers_have_the_levels_that_ros_gives_them(steps: list[tuple[str, int | None]]) -> None:
    theirs, ours = real(), LogLevels()
    theirs.rclpy_logging_shutdown()
    theirs.rclpy_logging_initialize()
    for name, level in steps:
        if level is not None:
            said = text_of(theirs.rclpy_logging_set_logger_level, name, level, True)
            own = text_of(ours.set, name, level)
            assert said == (own and own.replace("error", "error: Failed reason"))
        assert ours.get(name) == theirs.rclpy_logging_get_logger_level(name)
        assert ours.effective(name) == theirs.rclpy_logging_get_logger_effective_level(name)
    theirs.rclpy_logging_shutdown()
    theirs.rclpy_logging_initialize()


def test_levels_have_ros_names() -> None:
    for name, level in LEVELS.items():
        assert real().rclpy_logging_severity_level_from_string(name.lower()) == level


# -- what rclpy's modules find at import -----------------------------------------------------------


def looks(value: Any) -> Any:
    """Describe an enum, an exception, a structure or a constant."""
    members = getattr(value, "__members__", None)
    if members is not None:
        return [
            (name, int(one), repr(one), str(one), hash(one), one == int(one))
            for name, one in sorted(members.items())
        ]
    if isinstance(value, type) and issubclass(value, Exception):
        return [cls.__name__ for cls in value.__mro__]
    return type(value) if isinstance(value, type) or not isinstance(value, int) else value


def test_enums_exceptions_and_profiles_are_those_of_the_extension() -> None:
    theirs = real()
    for name in set(_TYPES) & set(dir(theirs)) - {"service_introspection"}:
        ours = getattr(extension, name)
        if "__members__" in dir(ours) or not name.islower():
            assert looks(ours) == looks(getattr(theirs, name)), name
        assert getattr(ours, "__module__", extension.NAME) == extension.NAME
    states = "ServiceIntrospectionState"
    introspection = extension.service_introspection
    assert looks(getattr(introspection, states)) == looks(
        getattr(theirs.service_introspection, states)
    )
    for code in extension.TransitionCallbackReturnType:
        assert code.to_label() == theirs.TransitionCallbackReturnType(code.value).to_label()
    for name in [*extension._PROFILES, "qos_profile_none"]:
        profile = text_of(extension.rmw_qos_profile_t.predefined, name)
        reference = text_of(theirs.rmw_qos_profile_t.predefined, name)
        if name == "qos_profile_rosout_default" and isinstance(reference, str):
            continue  # from ROS 2 Kilted on
        if not isinstance(profile, str):
            profile, reference = profile.to_dict(), reference.to_dict()
        assert profile == reference
    status = boundary().rclpy_action_get_rmw_qos_profile("rcl_action_qos_profile_status_default")
    assert status == theirs.rclpy_action_get_rmw_qos_profile(
        "rcl_action_qos_profile_status_default"
    )
    point = extension.rcl_time_point_t(5, theirs.ClockType.STEADY_TIME)
    assert (point.nanoseconds, point.clock_type.name) == (5, "STEADY_TIME")


def test_a_name_is_a_text() -> None:
    for check in (names.topic_fault, names.full_topic_fault, names.node_name_fault):
        with pytest.raises(TypeError):
            check(1)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        names.expand(1, "n", "/")  # type: ignore[arg-type]
