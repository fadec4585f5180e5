"""Nodes on one executor of rclpy's, whose callbacks make others ready as a seed says.

    python tests/adapters/rounds_program.py SEED…

prints who ran, in order, a line for each seed. Run by Python (over DDS) and by rsltrace. A callback
that makes timers sleeps until they are due, so that the order does not depend on how fast the
machine is.
"""

from __future__ import annotations

import random
import sys
import time
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

MOST = 60
"""How many callbacks do something that makes others ready."""


class Shared:
    """What the nodes of one system have in common."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.log: list[str] = []
        self.left = MOST
        self.made = 0
        self.goals = 8
        self.nodes: list[Busy] = []

    def note(self, what: str) -> None:
        """Write down what runs; the last to run ends it all."""
        self.log.append(what)


class Busy(Node):
    """Has some of everything; each callback does what chance says."""

    def __init__(self, shared: Shared) -> None:
        name = f"n{len(shared.nodes)}"
        super().__init__(name)
        self.shared = shared
        chance = shared.chance
        self.short = name
        groups = [MutuallyExclusiveCallbackGroup(), ReentrantCallbackGroup(), None]
        kinds = ["subscription"] * 3 + ["service", "client", "guard", "client", "action"]
        chance.shuffle(kinds)
        self.out = [self.create_publisher(UInt64, f"t{i}", 10) for i in range(4)]
        self.callers: list[Any] = []
        self.conditions: list[Any] = []
        for index, kind in enumerate(kinds):
            label = f"{name}.{kind}{index}"
            group = chance.choice(groups)
            if kind == "subscription":
                topic = f"t{chance.randrange(4)}"
                hear = self.hearing(label, is_async=not chance.randrange(4))
                self.create_subscription(UInt64, topic, hear, 10, callback_group=group)
            elif kind == "service":
                self.create_service(Trigger, name, self.serving(label), callback_group=group)
            elif kind == "client":
                server = f"n{chance.randrange(len(shared.nodes) + 1)}"
                group = groups[1]
                caller = self.create_client(Trigger, server, callback_group=group)
                self.callers.append((label, caller))
            elif kind == "guard":
                run = self.hearing(label, is_async=False)
                guard = self.create_guard_condition(lambda run=run: run(None), callback_group=group)
                self.conditions.append(guard)
            else:
                action, group = f"a_{name}", groups[1]
                reach = self.reaching(label)
                self.server = ActionServer(self, Fibonacci, action, reach, callback_group=group)
                self.goal_label = label
                self.goal_client = ActionClient(self, Fibonacci, action, callback_group=group)

    def hearing(self, label: str, *, is_async: bool) -> Any:
        def hear(message: Any) -> None:
            self.run(label)

        async def hear_async(message: Any) -> None:
            self.run(label)
            if self.callers and self.shared.left > 0:
                asked, caller = self.callers[0]
                await caller.call_async(Trigger.Request())
                self.run(f"{label} after {asked}")

        return hear_async if is_async else hear

    def serving(self, label: str) -> Any:
        def serve(request: Any, response: Any) -> Any:
            self.run(label)
            return response

        return serve

    def reaching(self, label: str) -> Any:
        def reach(goal: Any) -> Any:
            self.run(f"{label} goal")
            goal.publish_feedback(Fibonacci.Feedback())
            goal.succeed()
            return Fibonacci.Result()

        return reach

    def run(self, label: str) -> None:
        """Do what chance says, as long as there is anything left to do."""
        shared = self.shared
        shared.note(label)
        for _ in range(shared.chance.randrange(1, 5)):
            if shared.left > 0:
                shared.left -= 1
                shared.chance.choice(
                    [self.publish, self.publish, self.call, self.trigger, self.task,
                     self.tasks, self.alarms, self.goal]
                )()  # fmt: skip

    def publish(self) -> None:
        self.shared.chance.choice(self.out).publish(UInt64())

    def call(self) -> None:
        if self.callers:
            label, caller = self.shared.chance.choice(self.callers)
            future = caller.call_async(Trigger.Request())
            future.add_done_callback(lambda done: self.run(f"{label} done"))
            future.add_done_callback(lambda done: self.run(f"{label} done, too"))

    def trigger(self) -> None:
        for guard in self.conditions:
            guard.trigger()

    def task(self) -> None:
        number = self.number()
        self.executor.create_task(self.run, f"{self.short} task {number}")

    def tasks(self) -> None:
        number = self.number()

        async def first() -> None:
            self.run(f"{self.short} first {number}")

        async def second() -> None:
            self.run(f"{self.short} second {number}")
            await before
            self.shared.note(f"{self.short} second {number} goes on")

        before = self.executor.create_task(first)
        self.executor.create_task(second)

    def alarms(self) -> None:
        for _ in range(2):
            self.once(f"{self.short} timer {self.number()}")
        time.sleep(0.03)

    def once(self, label: str) -> None:
        def ring() -> None:
            timer.cancel()
            self.run(label)

        timer = self.create_timer(0.01, ring)

    def goal(self) -> None:
        if self.shared.goals == 0:  # more would be more than a server's queue holds
            return
        self.shared.goals -= 1
        goal = self.goal_client.send_goal_async(
            Fibonacci.Goal(), lambda said: self.run(f"{self.goal_label} feedback")
        )
        goal.add_done_callback(lambda done: self.accepted(done.result()))

    def accepted(self, goal: Any) -> None:
        self.run(f"{self.goal_label} accepted")
        result = goal.get_result_async()
        result.add_done_callback(lambda done: self.run(f"{self.goal_label} result"))

    def number(self) -> int:
        self.shared.made += 1
        return self.shared.made


class InOrder(dict):  # type: ignore[type-arg]
    """A set of nodes that keeps the order in which they came, which rclpy's does not."""

    def add(self, node: Node) -> None:
        self[node] = None

    def remove(self, node: Node) -> None:
        del self[node]


def nodes_of(shared: Shared, seed: int) -> list[Busy]:
    """Make the nodes of a seed."""
    for _ in range(1 + seed % 3):
        shared.nodes.append(Busy(shared))
    return shared.nodes


def order(seed: int) -> list[str]:
    """Run the system of a seed until nothing is left to do; return who ran when."""
    shared = Shared(seed)
    executor = SingleThreadedExecutor()
    executor._nodes = InOrder()
    for node in nodes_of(shared, seed):
        executor.add_node(node)
    for node in shared.nodes:
        for _, caller in node.callers:
            caller.wait_for_service()
        node.goal_client.wait_for_server()
    time.sleep(0.5)  # everybody has heard of everybody
    shared.nodes[0].once("begin")
    quiet = 0
    while quiet < 20:
        seen = len(shared.log)
        executor.spin_once(timeout_sec=0.05)
        quiet = quiet + 1 if len(shared.log) == seen else 0
    for node in shared.nodes:
        executor.remove_node(node)
        node.destroy_node()
    executor.shutdown()
    return shared.log


if __name__ == "__main__":
    rclpy.init()
    for argument in sys.argv[1:]:
        print(argument, *order(int(argument)), sep="; ")
    rclpy.shutdown()
