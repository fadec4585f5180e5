"""Actions: a goal, its feedback, result or end is another one, or comes at another time."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import OUTPUT, Change, behaviour
from campaigns.truth.faults.planting import Planted, Truth, fault
from campaigns.truth.faults.settings import NEVER, changed
from campaigns.truth.graph import Callback, NodePlan, World, random_world

TOP = [
    "from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse",
    "from rclpy.callback_groups import ReentrantCallbackGroup",
    "from test_msgs.action import Fibonacci",
]


def worker() -> NodePlan:
    """Return the server: it works 10 ms for each number."""
    setup = [
        "self.server = ActionServer(",
        '    self, Fibonacci, "/count", self.work, goal_callback=self.decide,',
        "    cancel_callback=self.stop, callback_group=ReentrantCallbackGroup())",
    ]
    work = [
        "feedback = Fibonacci.Feedback(sequence=[0])",
        "# before",
        "for step in range(goal.request.order % 3 + 2):",
        "    time.sleep(0.01)",
        "    if goal.is_cancel_requested:",
        "        goal.canceled()",
        "        return Fibonacci.Result(sequence=[-1])",
        "    feedback.sequence.append(step)",
        "    # step",
        "    goal.publish_feedback(feedback)",
        "result = Fibonacci.Result(sequence=feedback.sequence)",
        "# end",
        "goal.succeed()",
        "return result",
    ]
    decide = ["answer = GoalResponse.ACCEPT", "# before", "return answer"]
    stop = ["answer = CancelResponse.ACCEPT", "# before", "return answer"]
    callbacks = [
        Callback("work", "action", "/count", work, arguments="goal"),
        Callback("decide", "action", "/count", decide, arguments="request"),
        Callback("stop", "action", "/count", stop, arguments="goal"),
    ]
    return NodePlan("worker", "worker", setup, callbacks, top=TOP)


def asker(cancels: int) -> NodePlan:
    """Return the client: it asks every 80 ms, and cancels its goal ``cancels``."""
    setup = [
        "self.asked = 0",
        "self.last = 0",
        'self.out = self.create_publisher(Float64, "/results", 10)',
        'self.client = ActionClient(self, Fibonacci, "/count")',
        "self.timer = self.create_timer(0.08, self.tick)",
    ]
    tick = [
        "self.asked += 1",
        "goal = Fibonacci.Goal(order=self.asked)",
        "# before",
        "future = self.client.send_goal_async(goal, feedback_callback=self.feedback)",
        "future.order = self.asked",
        "future.add_done_callback(self.accepted)",
        "# after",
    ]
    accepted = [
        "goal = future.result()",
        "# before",
        "if goal.accepted:",
        "    goal.get_result_async().add_done_callback(self.done)",
        f"    if future.order == {cancels}: goal.cancel_goal_async()",
    ]
    done = [
        "value = float(sum(future.result().result.sequence))",
        "# before",
        "self.out.publish(Float64(data=value))",
    ]
    callbacks = [
        Callback("tick", "timer", "Asker.tick", tick),
        Callback("accepted", "task", "/count", accepted, arguments="future"),
        Callback("done", "task", "/count", done, "/results", arguments="future"),
        Callback("feedback", "action", "/count", ["self.last = message.feedback.sequence[-1]"]),
    ]
    return NodePlan("asker", "asker", setup, callbacks, top=TOP)


def with_action(world: World, cancels: int = 0) -> tuple[NodePlan, NodePlan]:
    """Add server and client to a world."""
    server, client = worker(), asker(cancels)
    world.add(server, client)
    return server, client


def _served(
    name: str,
    lines: list[str],
    *first: str,
    mark: str = "# before",
    method: str = "work",
    verdicts: tuple[str, ...] = OUTPUT,
    cancels: bool = False,
) -> None:
    """Register two classes: the server does something else for one of its goals."""

    def make(rng: random.Random, world: World) -> Change:
        order = rng.randint(1, 4)
        server, _ = with_action(world, order if cancels else 0)
        request = "request.order" if method == "decide" else "goal.request.order"
        truth = Truth(verdicts, server.full_name, first=first, independent=None)
        condition = f"{request} == {order}" + (" and step == 1" if mark == "# step" else "")
        return Change(server, lines, truth, mark, condition, method)

    behaviour(name)(make)


def _asked(
    name: str,
    lines: list[str],
    *first: str,
    mark: str = "# before",
    method: str = "tick",
    verdicts: tuple[str, ...] = OUTPUT,
) -> None:
    """Register two classes: the client does something else for one of its goals."""

    def make(rng: random.Random, world: World) -> Change:
        _, client = with_action(world)
        order = rng.randint(1, 4)
        condition = f"{'self.asked' if method == 'tick' else 'future.order'} == {order}"
        truth = Truth(verdicts, client.full_name, first=first, independent=None)
        return Change(client, lines, truth, mark, condition, method)

    behaviour(name)(make)


_served("goal rejected", ["answer = GoalResponse.REJECT"], "/count", method="decide")
_served("goal aborted", ["goal.abort()", "return result"], "/count", mark="# end")
_served("goal cancelled by nobody", ["goal.abort()", "return Fibonacci.Result()"], "/count")
_served("feedback of another value", ["feedback.sequence[-1] += 40"], "/count", mark="# step")
_served("feedback late", ["time.sleep(0.003)"], "/count", mark="# step")
_served("feedback left out", ["continue"], "/count", mark="# step")
_served("feedback twice", ["goal.publish_feedback(feedback)"], "/count", mark="# step")
_served("result of another value", ["result.sequence.append(7)"], "/count", mark="# end")
_served("result late", ["time.sleep(0.006)"], "/count", mark="# end")
_served(
    "goal whose work raises",
    ['raise RuntimeError("planted")'],
    'log ERROR "Error raised in execute callback: planted" only in b',
)
_served("cancel refused", ["answer = CancelResponse.REJECT"], "/count", method="stop", cancels=True)
_asked("another goal", ["goal.order += 3"], "/count")
_asked("goal not sent", ["return"], "/count")
_asked("goal sent twice", ["self.client.send_goal_async(goal)"], "/count")
_asked("goal cancelled", ["goal.cancel_goal_async()"], "/count", method="accepted")
_asked("result not asked for", ["return"], "/count", method="accepted")
_asked("client that slept", ["time.sleep(0.002)"], "/count", method="accepted")


@fault("delay of an action's goals")
def goal_delay(rng: random.Random) -> Planted:
    a = random_world(rng)
    with_action(a)
    a.job["delay"] = {"services": {"/count/_action/send_goal": "1ms"}}
    b = changed(a, "delay", {"services": {"/count/_action/send_goal": "4ms"}})
    first = (r"1 ms.* 4 ms", "/count")
    truth = Truth(("draw", "timing"), first=first, says=("delay",), never=NEVER, independent=None)
    return Planted(a, b, truth)
