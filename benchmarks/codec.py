"""What serializing costs: rsltrace's generated codecs, rclpy's C path and rosbags' generated ones.

    python benchmarks/codec.py             all messages, about ten seconds
    python benchmarks/codec.py Imu Path    only these
    python benchmarks/codec.py --json      the same figures for a machine

Microseconds per call, the best of several rounds; the rounds go round all three, so that a busy
moment of the machine does not hit one alone. In brackets, how many times as long rclpy and rosbags
take. rosbags reads into classes of its own; rsltrace and rclpy make the messages that nodes use.
The garbage collector is off while the clock runs, as it is for timeit.
"""

from __future__ import annotations

import argparse
import json
import sys
import timeit
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import Imu, JointState, LaserScan, NavSatFix, PointCloud2, PointField
from std_msgs.msg import Header, String, UInt64
from std_srvs.srv import Trigger

from rsltrace.adapters.rclpy.messages.codec import codec_for
from rsltrace.adapters.rclpy.messages.interfaces import schema_text

ROUNDS = 7
ROUND_S = 0.02
AIMS_US = {("UInt64", "serialize"): 0.6, ("UInt64", "deserialize"): 0.8}
AIMS_US |= {("Imu", "serialize"): 4.0, ("Imu", "deserialize"): 7.0}


def samples() -> Iterator[tuple[str, Any]]:
    """The messages measured, small to large, by the name they are shown with."""
    header = Header(frame_id="base_link")
    yield "UInt64", UInt64(data=7)
    yield "String", String(data="hello world")
    yield "Trigger.Response", Trigger.Response(success=True, message="14807076229895937644")
    yield "Imu", Imu(header=header)
    yield "NavSatFix", NavSatFix(header=header)
    yield "Odometry", Odometry(header=header, child_frame_id="odom")
    yield "TransformStamped", TransformStamped(header=header, child_frame_id="odom")
    names = [f"joint_{index}" for index in range(7)]
    yield (
        "JointState",
        JointState(header=header, name=names, position=[0.1] * 7, velocity=[0.2] * 7),
    )
    yield "LaserScan", LaserScan(header=header, ranges=[1.5] * 1080, intensities=[2.5] * 1080)
    yield "Path", PathMessage(header=header, poses=[PoseStamped(header=header)] * 100)
    fields = [PointField(name=name, datatype=7, count=1) for name in "xyz"]
    yield "PointCloud2", PointCloud2(header=header, fields=fields, data=bytes(1 << 20))


def best_us(calls: dict[str, Callable[[], Any]]) -> dict[str, float]:
    """Return the microseconds per call of each of ``calls``."""
    timers = {name: timeit.Timer(call) for name, call in calls.items()}
    numbers = {}
    for name, timer in timers.items():
        timer.timeit(1)  # the first call generates code or imports type support
        number, seconds = 1, timer.timeit(1)
        while seconds < ROUND_S / 4:
            number *= 4
            seconds = timer.timeit(number)
        numbers[name] = max(1, round(number * ROUND_S / seconds))
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(ROUNDS):
        for name, timer in timers.items():
            best[name] = min(best[name], timer.timeit(numbers[name]) / numbers[name] * 1e6)
    return best


def measure(message: Any) -> dict[str, dict[str, float]]:
    """Return microseconds by direction and by library."""
    cls = type(message)
    codec = codec_for(cls)
    raw = codec.serialize(message)
    store = get_typestore(Stores.EMPTY)
    types = get_types_from_msg(schema_text(cls), codec.type_name)
    store.register(types)
    name = next(name for name in types if name.endswith(f"/{cls.__name__}"))
    foreign = store.deserialize_cdr(raw, name)
    assert bytes(store.serialize_cdr(foreign, name)) == raw
    return {
        "serialize": best_us(
            {
                "rsltrace": lambda: codec.serialize(message),
                "rclpy": lambda: serialize_message(message),
                "rosbags": lambda: store.serialize_cdr(foreign, name),
            }
        ),
        "deserialize": best_us(
            {
                "rsltrace": lambda: codec.deserialize(raw),
                "rclpy": lambda: deserialize_message(raw, cls),
                "rosbags": lambda: store.deserialize_cdr(raw, name),
            }
        ),
        "canonical": best_us({"rsltrace": lambda: codec.canonical(raw)}),
        "copy": best_us({"rsltrace": lambda: bytearray(raw)}),
    }


def row(name: str, figures: dict[str, dict[str, float]]) -> str:
    """Return one line of the table."""
    cells = [f"{name:16}"]
    for direction in ("serialize", "deserialize"):
        own = figures[direction]["rsltrace"]
        others = " ".join(
            f"{figures[direction][library] / own:5.1f}x" for library in ("rclpy", "rosbags")
        )
        aim = AIMS_US.get((name, direction))
        mark = "" if aim is None else " ok" if own <= aim else f" > {aim}"
        cells.append(f"{own:8.2f} ({others}){mark:6}")
    cells.append(f"{figures['canonical']['rsltrace']:8.2f} {figures['copy']['rsltrace']:8.2f}")
    return " ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="messages to measure (all)")
    parser.add_argument("--json", action="store_true", help="print figures for a machine")
    arguments = parser.parse_args()
    chosen = {n: m for n, m in samples() if not arguments.names or n in arguments.names}
    if not chosen:
        parser.error(f"no such message; there are {', '.join(name for name, _ in samples())}")
    if arguments.json:
        print(json.dumps({name: measure(message) for name, message in chosen.items()}, indent=2))
        return
    print(
        f"{'us per call':16} {'serialize (rclpy rosbags)':29} {'deserialize':29} canonical  memcpy"
    )
    for name, message in chosen.items():
        print(row(name, measure(message)), flush=True)


if __name__ == "__main__":
    main()
