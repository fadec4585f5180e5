"""Messages of other types than numbers: what differs in them is named as it is."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import Change, behaviour, truth_of
from campaigns.truth.faults.planting import one_of
from campaigns.truth.graph import World


def message(
    name: str,
    made: str,
    change: str,
    *first: str,
    shows: tuple[str, ...] = (),
    recorded: bool = True,
) -> None:
    """Register two classes: a source publishes ``made`` on /typed, and at one call ``change`` is
    done to it first."""

    def make(rng: random.Random, world: World) -> Change:
        node = one_of(rng, world, "source")
        kind = made.partition("(")[0]
        node.setup.append(f'self.typed = self.create_publisher({kind}, "/typed", 10)')
        lines = node.callbacks[0].lines
        at = lines.index("# before")
        lines[at : at + 1] = [f"typed = {made}", "# before", "self.typed.publish(typed)"]
        if not recorded:
            world.job["record"] = {"exclude": ["/typed"]}
        truth = truth_of(node, first=(r"/typed", *first), shows=shows)
        return Change(node, [change], truth, at=rng.randint(1, 6))

    behaviour(name)(make)


message("text", 'String(data="ready")', 'typed.data = "steady"', 'data "ready" → "steady"')
message("text that is gone", 'String(data="on")', 'typed.data = ""', 'data "on" → ""')
message("text in two lines", 'String(data="a b")', 'typed.data = "a\\nb"', r'data "a b" → "a\\nb"')
message(
    "NaN", "Float64(data=2.5)", 'typed.data = float("nan")', r"data 2\.5 → nan", shows=("NaN in b",)
)
message("infinity", "Float64(data=2.5)", 'typed.data = float("-inf")', r"data 2\.5 → -inf")
message(
    "zero of the other sign",
    "Float64(data=0.0)",
    "typed.data = -0.0",
    r"data 0\.0 → -0\.0",
    shows=("sign of zero",),
)
message(
    "last place of a number",
    "Float64(data=0.1)",
    "typed.data = math.nextafter(0.1, 1.0)",
    r"data 0\.1 → 0\.10000000000000002",
    shows=(r"\b1 ulp",),
)
message(
    "last place of a narrow number",
    "Float32(data=0.5)",
    "typed.data = 0.5 + 2.0**-24",
    r"data 0\.5 → 0\.5000000\d+",
    shows=(r"\b1 ulp",),
)
message(
    "large whole number",
    "Int64(data=2**53 + 1)",
    "typed.data += 1",
    "data 9007199254740993 → 9007199254740994",
    shows=(r"\|a-b\| 1\b",),
)
message("truth value", "Bool(data=True)", "typed.data = False", r"data [Tt]rue → [Ff]alse")
message(
    "element of a large array",
    "Float64MultiArray(data=[i * 0.5 for i in range(3000)])",
    "typed.data[1234] = -1.0",
    r"data\[1234\] 617\.0 → -1\.0",
)
message(
    "elements of a large array",
    "Float64MultiArray(data=[i * 0.5 for i in range(3000)])",
    "for i in range(100, 140): typed.data[i] += 1.0",
    r"40 of 3000 elements of data",
    shows=(r"\[100\] 50\.0 | 51\.0",),
)
message(
    "NaN in an array",
    "Float64MultiArray(data=[1.0, 2.0, 3.0])",
    'typed.data[1] = float("nan")',
    r"data\[1\] 2\.0 → nan",
    shows=("NaN in b",),
)
message(
    "longer array",
    "Float64MultiArray(data=[1.0, 2.0, 3.0])",
    "typed.data.append(9.0)",
    r"\bdata\b",
    shows=("length 3 and 4",),
)
message(
    "empty array",
    "Float64MultiArray(data=[1.0, 2.0, 3.0])",
    "typed.data = []",
    r"\bdata\b",
    shows=("length 3 and 0",),
)
message(
    "rotated array",
    "Float64MultiArray(data=[1.0, 2.0, 3.0, 4.0])",
    "typed.data = [2.0, 3.0, 4.0, 1.0]",
    "same elements in a different order",
)
message(
    "sorted array with equal elements",
    "Float64MultiArray(data=[3.0, 1.0, 3.0, 2.0])",
    "typed.data = sorted(typed.data)",
    "same elements in a different order",
)
message(
    "array with one element of another",
    "Float64MultiArray(data=[3.0, 1.0, 3.0, 2.0])",
    "typed.data = [1.0, 1.0, 3.0, 2.0]",
    r"data\[0\] 3\.0 → 1\.0",
)
message(
    "byte of many",
    "UInt8MultiArray(data=bytes(range(200)))",
    "typed.data[70] = 255",
    r"\bdata\b",
    shows=(r"data.*\b70\b",),
)
message(
    "field in a field",
    "PoseStamped()",
    "typed.pose.position.y = 0.25",
    r"pose\.position\.y 0\.0 → 0\.25",
)
message(
    "two fields",
    "PoseStamped()",
    'typed.header.frame_id = "map"; typed.pose.orientation.z = 1.0',
    r'header\.frame_id "" → "map" and 1 more field',
    shows=(r"pose\.orientation\.z",),
)
message("stamp", "PoseStamped()", "typed.header.stamp.sec = 7", r"header\.stamp 0\.0* → 7\.0*")
message(
    "payload that was not recorded",
    'String(data="ready")',
    'typed.data = "steady"',
    shows=("only its hash was recorded", r"record:"),
    recorded=False,
)
