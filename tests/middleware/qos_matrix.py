"""Pairs of a publisher and a subscription with all kinds of QoS, and what becomes of each.

The same two nodes run natively over DDS (in two processes: within one, Fast DDS loses sight of
automatic liveliness) and under rsltrace, and what each end of each pair went through has to be the
same. Every pair has a topic of its own. Natively: ``python qos_matrix.py NODE SEED COUNT START
SLOWER``; all takes so many times longer, for busy machines.
"""

from __future__ import annotations

import copy
import json
import os
import random
import sys
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from std_msgs.msg import UInt64

MS = 1_000_000
SLOWER = int(sys.argv[5]) if __name__ == "__main__" else 1
CHOICES: dict[str, list[Any]] = {
    "reliability": ["RELIABLE", "BEST_EFFORT"],
    "durability": ["VOLATILE", "TRANSIENT_LOCAL"],
    "history": [("KEEP_LAST", 2), ("KEEP_LAST", 10), ("KEEP_ALL", 0)],
    "deadline": [None, 300, 500],
    "lifespan": [None, 400],
    "liveliness": ["AUTOMATIC", "MANUAL_BY_TOPIC"],
    "lease": [None, 400, 600],
}
# Seconds since the nodes were made (natively discovery comes first): publish, be silent, join late.
FIRST_S, PERIOD_S, MESSAGES = 1.0, 0.1, 5
LOOK_S, JOIN_S, END_S = 2.0, 2.2, 2.75


def pairs(seed: int, count: int) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return some of all pairs of offered and requested QoS."""
    chance = random.Random(seed)

    def one() -> dict[str, Any]:
        return {name: chance.choice(values) for name, values in CHOICES.items()}

    chosen = []
    for _ in range(count):
        offered, requested = one(), one()
        if chance.random() < 0.7:  # mostly compatible, or there is little to see
            for name in ("reliability", "durability", "deadline", "liveliness", "lease"):
                requested[name] = offered[name]
            if chance.random() < 0.5:  # less than what is offered
                weaker = chance.choice(["reliability", "durability", "deadline", "lease"])
                values = {"reliability": "BEST_EFFORT", "durability": "VOLATILE"}
                requested[weaker] = values.get(weaker)
        chosen.append((offered, requested))
    return chosen


def profile(values: dict[str, Any]) -> QoSProfile:
    """Return the QoS profile of some values."""
    history, depth = values["history"]
    limits = {
        key: Duration(nanoseconds=values[name] * MS * SLOWER)
        for name, key in (
            ("deadline", "deadline"),
            ("lifespan", "lifespan"),
            ("lease", "liveliness_lease_duration"),
        )
        if values[name] is not None
    }
    return QoSProfile(
        history=QoSHistoryPolicy[history],
        depth=depth,
        reliability=QoSReliabilityPolicy[values["reliability"]],
        durability=QoSDurabilityPolicy[values["durability"]],
        liveliness=QoSLivelinessPolicy[values["liveliness"]],
        **limits,
    )


class Offered:
    """One publisher, and what it went through."""

    def __init__(self, node: Node, number: int, values: Any) -> None:
        self.outcome: dict[str, Any] = {"deadlines": 0, "lost": 0, "incompatible": 0, "peers": 0}
        self.publisher = node.create_publisher(
            UInt64,
            f"pair_{number}",
            profile(values),
            event_callbacks=PublisherEventCallbacks(
                deadline=lambda s: self._count("deadlines", s.total_count_change),
                liveliness=lambda s: self._count("lost", s.total_count_change),
                incompatible_qos=self._incompatible,
            ),
        )

    def look(self) -> None:
        self.outcome["peers"] = self.publisher.get_subscription_count()

    def _count(self, what: str, change: int) -> None:
        self.outcome[what] += change

    def _incompatible(self, status: Any) -> None:
        self.outcome["incompatible"] = int(status.last_policy_kind)


class Asked:
    """One subscription from the start, one that joins late, and what they went through."""

    def __init__(self, node: Node, number: int, values: Any) -> None:
        self.outcome: dict[str, Any] = {
            "early": [],
            "late": [],
            "deadlines": 0,
            "liveliness": [],
            "incompatible": 0,
            "peers": 0,
        }
        self._node, self._topic, self._profile = node, f"pair_{number}", profile(values)
        # In Fast DDS history that reaches one subscription asserts liveliness for all others of its
        # process, so the late one has no lease.
        self._late_profile = profile({**values, "lease": None})
        self.subscription = node.create_subscription(
            UInt64,
            self._topic,
            lambda message: self.outcome["early"].append(message.data),
            self._profile,
            event_callbacks=SubscriptionEventCallbacks(
                deadline=lambda s: self._count("deadlines", s.total_count_change),
                liveliness=lambda s: self.outcome["liveliness"].append(
                    [s.alive_count, s.not_alive_count]
                ),
                incompatible_qos=self._incompatible,
            ),
        )

    def join(self) -> None:
        self.late = self._node.create_subscription(
            UInt64,
            self._topic,
            lambda message: self.outcome["late"].append(message.data),
            self._late_profile,
        )

    def look(self) -> None:
        self.outcome["peers"] = self.subscription.get_publisher_count()

    def _count(self, what: str, change: int) -> None:
        self.outcome[what] += change

    def _incompatible(self, status: Any) -> None:
        self.outcome["incompatible"] = int(status.last_policy_kind)


class _Timeline(Node):  # type: ignore[misc]
    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.done = False
        self.once(LOOK_S, self._look)
        self.once(END_S, self._end)

    def once(self, after_s: float, action: Any) -> None:
        def act() -> None:
            timer.cancel()
            action()

        timer = self.create_timer(after_s * SLOWER, act)

    def _look(self) -> None:
        for end in self.ends:
            end.look()

    def _end(self) -> None:
        self.outcomes: list[dict[str, Any]] = [copy.deepcopy(end.outcome) for end in self.ends]
        self.done = True


class Offers(_Timeline):
    """The publishers of all pairs."""

    def __init__(self, seed: int = 0, count: int = 40) -> None:
        super().__init__("offers")
        self.ends = [Offered(self, i, offered) for i, (offered, _) in enumerate(pairs(seed, count))]
        for number in range(MESSAGES):
            self.once(FIRST_S + number * PERIOD_S, lambda number=number: self.send(number + 1))

    def send(self, number: int) -> None:
        for end in self.ends:
            end.publisher.publish(UInt64(data=number))


class Asks(_Timeline):
    """The subscriptions of all pairs."""

    def __init__(self, seed: int = 0, count: int = 40) -> None:
        super().__init__("asks")
        self.ends = [Asked(self, i, asked) for i, (_, asked) in enumerate(pairs(seed, count))]
        self.once(JOIN_S, self.join)

    def join(self) -> None:
        for end in self.ends:
            end.join()


def main() -> None:
    import rclpy
    from rclpy.experimental import EventsExecutor

    name, seed, count, start = sys.argv[1:5]
    rclpy.init()
    time.sleep(max(float(start) - time.time(), 0))
    node = {"offers": Offers, "asks": Asks}[name](int(seed), int(count))
    executor = EventsExecutor()
    executor.add_node(node)
    while not node.done:
        executor.spin_once(timeout_sec=0.1)
    time.sleep(0.5 * SLOWER)  # the other end must not see this one go before it is done itself
    print(json.dumps(node.outcomes), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
