"""Reading ``offered_qos_profiles``, whose form has changed with rosbag2's versions.

It is a YAML text (in storage files, and in metadata.yaml up to version 8) or a list already parsed
(metadata.yaml from version 9); policies are numbers (up to version 8) or words.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rsltrace.trace.model.nesting import nested_too_deep
from rsltrace.trace.model.stamp import NS_PER_S
from rsltrace.trace.recordings.topic import DURATION_INFINITE_NS, BagQos

# In the order of the enumerations in rmw/types.h.
HISTORY = ("system_default", "keep_last", "keep_all", "unknown")
RELIABILITY = ("system_default", "reliable", "best_effort", "unknown", "best_available")
DURABILITY = ("system_default", "transient_local", "volatile", "unknown", "best_available")
LIVELINESS = (
    "system_default",
    "automatic",
    "manual_by_node",
    "manual_by_topic",
    "unknown",
    "best_available",
)

# How DDS, and ROS 2 until Galactic, wrote a duration without end.
_DDS_INFINITE = (0x7FFFFFFF, 0xFFFFFFFF)


def parse_qos(profiles: object) -> tuple[BagQos, ...]:
    """Return the profiles in a YAML text or parsed list. Raises ``ValueError`` when it is neither.

    What a profile leaves out is "unknown" or 0, as for a publisher that did not say.
    """
    if isinstance(profiles, str):
        return _parse_text(profiles)
    if profiles is None:
        return ()
    if not isinstance(profiles, list):
        raise ValueError(f"a list of QoS profiles was expected, not {profiles!r}")
    return tuple(_profile(item) for item in profiles)


# A recording repeats the same few texts for its many topics, and parsing YAML is slow.
@lru_cache(maxsize=256)
def _parse_text(text: str) -> tuple[BagQos, ...]:
    if not text.strip():
        return ()
    if nested_too_deep(text) >= 0:
        raise ValueError("the QoS profiles are nested too deeply")
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        value = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, RecursionError) as error:
        raise ValueError(f"the QoS profiles are not YAML: {error}") from None
    if isinstance(value, str):
        raise ValueError(f"a list of QoS profiles was expected, not {value!r}")
    return parse_qos(value)


def _profile(item: object) -> BagQos:
    if not isinstance(item, dict):
        raise ValueError(f"a QoS profile was expected, not {item!r}")
    depth = item.get("depth", 0)
    return BagQos(
        history=_policy(item.get("history"), HISTORY),
        depth=depth if isinstance(depth, int) else 0,
        reliability=_policy(item.get("reliability"), RELIABILITY),
        durability=_policy(item.get("durability"), DURABILITY),
        deadline_ns=_duration_ns(item.get("deadline")),
        lifespan_ns=_duration_ns(item.get("lifespan")),
        liveliness=_policy(item.get("liveliness"), LIVELINESS),
        liveliness_lease_duration_ns=_duration_ns(item.get("liveliness_lease_duration")),
        avoid_ros_namespace_conventions=item.get("avoid_ros_namespace_conventions") is True,
    )


def _policy(value: object, words: tuple[str, ...]) -> str:
    if isinstance(value, int) and 0 <= value < len(words):
        return words[value]
    if isinstance(value, str) and value.lower() in words:
        return value.lower()
    return "unknown"


def _duration_ns(value: Any) -> int:
    if not isinstance(value, dict):
        return 0
    sec, nsec = value.get("sec", 0), value.get("nsec", 0)
    if not isinstance(sec, int) or not isinstance(nsec, int):
        return 0
    if (sec, nsec) == _DDS_INFINITE:
        return DURATION_INFINITE_NS
    return min(max(sec * NS_PER_S + nsec, 0), DURATION_INFINITE_NS)
