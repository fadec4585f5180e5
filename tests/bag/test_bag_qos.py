"""QoS profiles are read in all the forms rosbag2 has written them."""

from __future__ import annotations

import pytest

from rsltrace.trace.recordings import DURATION_INFINITE_NS, BagQos, BagTopic
from rsltrace.trace.recordings.topic import parse_qos

WORDS = """\
- history: keep_all
  depth: 3
  reliability: reliable
  durability: transient_local
  deadline: {sec: 1, nsec: 5}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: manual_by_topic
  liveliness_lease_duration: {sec: 2147483647, nsec: 4294967295}
  avoid_ros_namespace_conventions: true
"""
NUMBERS = (
    WORDS.replace("keep_all", "2")
    .replace(": reliable", ": 1")
    .replace("transient_local", "1")
    .replace("manual_by_topic", "3")
)
EXPECTED = BagQos(
    history="keep_all",
    depth=3,
    reliability="reliable",
    durability="transient_local",
    deadline_ns=1_000_000_005,
    lifespan_ns=DURATION_INFINITE_NS,
    liveliness="manual_by_topic",
    liveliness_lease_duration_ns=DURATION_INFINITE_NS,
    avoid_ros_namespace_conventions=True,
)
UNKNOWN = BagQos("unknown", 0, "unknown", "unknown", 0, 0, "unknown", 0, False)


@pytest.mark.parametrize("text", [WORDS, NUMBERS, WORDS.upper().lower()])
def test_words_and_numbers_mean_the_same(text: str) -> None:
    assert parse_qos(text) == (EXPECTED,)


def test_a_list_already_parsed_is_taken_as_it_is() -> None:
    assert parse_qos([{"history": "KEEP_LAST", "depth": 7}])[0].history == "keep_last"


@pytest.mark.parametrize("nothing", ["", "  \n", None, [], "[]", "# nothing"])
def test_no_profiles(nothing: object) -> None:
    assert parse_qos(nothing) == ()


@pytest.mark.parametrize(
    "profile",
    [
        {},
        {"history": 99, "depth": "x", "deadline": 3, "lifespan": {"sec": "a"}},
        {"history": -1, "reliability": "perhaps", "durability": None},
    ],
)
def test_what_is_not_said_is_unknown(profile: dict[str, object]) -> None:
    assert parse_qos([profile]) == (UNKNOWN,)


@pytest.mark.parametrize(
    ("bad", "expected"),
    [
        ("a: [", "the QoS profiles are not YAML"),
        ("text", "a list of QoS profiles was expected, not 'text'"),
        ("{a: 1}", "a list of QoS profiles was expected"),
        ("[1]", "a QoS profile was expected, not 1"),
        (5, "a list of QoS profiles was expected, not 5"),
    ],
)
def test_what_is_no_profile_is_refused(bad: object, expected: str) -> None:
    with pytest.raises(ValueError, match=expected.replace("[", r"\[")):
        parse_qos(bad)


@pytest.mark.parametrize("around", ["{{{}}}", "[{{{}}}, *a6]"])
def test_a_value_that_repeats_itself_by_references_makes_no_long_error(around: str) -> None:
    lists = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 6)}]" for n in range(1, 7)]
    with pytest.raises(ValueError, match="expected") as raised:
        parse_qos(around.format(", ".join(["a0: &a0 [x]", *lists])))
    assert len(str(raised.value)) < 1000


def test_a_topic_has_one_qos_only_if_its_publishers_agree() -> None:
    def topic(*offered: BagQos) -> BagTopic:
        return BagTopic("/a", "m/msg/A", "cdr", offered, 0, None, "", "")

    assert topic().qos is None
    assert topic(EXPECTED, EXPECTED).qos == EXPECTED
    assert topic(EXPECTED, UNKNOWN).qos is None
