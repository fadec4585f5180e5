"""Lifecycle nodes: a transition is refused, fails, is asked for otherwise, does something else."""

from __future__ import annotations

import random

from campaigns.truth.faults.behaviour import OUTPUT, Change, behaviour
from campaigns.truth.faults.planting import Truth
from campaigns.truth.graph import Callback, NodePlan, World

TOP = [
    "from lifecycle_msgs.msg import Transition",
    "from lifecycle_msgs.srv import ChangeState",
    "from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn",
]
STEPS = ("CONFIGURE", "ACTIVATE", "DEACTIVATE", "ACTIVATE", "DEACTIVATE", "CLEANUP")


def camera() -> NodePlan:
    """Return a node that publishes while it is active."""
    configure = [
        "self.offset, self.ticks = 0.5, 0",
        'self.images = self.create_lifecycle_publisher(Float64, "/images", 10)',
        "self.timer = self.create_timer(0.02, self.tick)",
        "# before",
        "return super().on_configure(state)",
    ]
    activate = ["# before", "return super().on_activate(state)"]
    deactivate = ["# before", "return super().on_deactivate(state)"]
    cleanup = ["# before", "self.destroy_timer(self.timer)", "return super().on_cleanup(state)"]
    error = ["# before", "return TransitionCallbackReturn.SUCCESS"]
    tick = [
        "self.ticks += 1",
        "value = self.offset",
        "# before",
        "self.images.publish(Float64(data=value))",
    ]
    callbacks = [
        Callback("on_configure", "service", "", configure, arguments="state"),
        Callback("on_activate", "service", "", activate, arguments="state"),
        Callback("on_deactivate", "service", "", deactivate, arguments="state"),
        Callback("on_cleanup", "service", "", cleanup, arguments="state"),
        Callback("on_error", "service", "", error, arguments="state"),
        Callback("tick", "timer", "Camera.tick", tick, "/images", 20),
    ]
    return NodePlan("camera", "camera", [], callbacks, top=TOP, base="LifecycleNode")


def manager() -> NodePlan:
    """Return a node that takes the camera through its states, one every 60 ms."""
    setup = [
        'self.client = self.create_client(ChangeState, "/camera/change_state")',
        f"self.steps = {[*STEPS]!r}",
        "self.timer = self.create_timer(0.06, self.tick)",
    ]
    tick = [
        "steps = self.steps",
        "# before",
        "if steps:",
        '    step = getattr(Transition, f"TRANSITION_{steps.pop(0)}")',
        "    transition = Transition(id=step)",
        "    self.client.call_async(ChangeState.Request(transition=transition))",
    ]
    callbacks = [Callback("tick", "timer", "Manager.tick", tick)]
    return NodePlan("manager", "manager", setup, callbacks, top=TOP)


def _lived(
    name: str, method: str, lines: list[str], *first: str, verdicts: tuple[str, ...] = OUTPUT
) -> None:
    """Register two classes: the camera does something else in one of its transitions."""

    def make(rng: random.Random, world: World) -> Change:
        node = camera()
        world.add(node, manager())
        truth = Truth(verdicts, node.full_name, first=first, independent=None)
        return Change(node, lines, truth, method=method)

    behaviour(name)(make)


def _managed(name: str, lines: list[str], *first: str) -> None:
    """Register two classes: the manager asks for something else once."""

    def make(rng: random.Random, world: World) -> Change:
        node = manager()
        world.add(camera(), node)
        truth = Truth(OUTPUT, node.full_name, "Manager.tick", first=first, independent=None)
        return Change(node, lines, truth, at=rng.randint(1, 4))

    behaviour(name)(make)


FAILURE = ["return TransitionCallbackReturn.FAILURE"]
CHANGE = "/camera/change_state"
_lived("configuring refused", "on_configure", FAILURE, CHANGE)
_lived("activating refused", "on_activate", FAILURE, CHANGE)
_lived("deactivating refused", "on_deactivate", FAILURE, CHANGE)
_lived("cleaning up refused", "on_cleanup", FAILURE, CHANGE)
_lived("transition with an error", "on_activate", ["return TransitionCallbackReturn.ERROR"], CHANGE)
_lived(
    "transition that raises",
    "on_activate",
    ['raise RuntimeError("planted")'],
    CHANGE,
    r"on_activate of /camera raised RuntimeError: planted at truth_camera\.py:\d+ only in b",
)
_lived("transition that takes time", "on_activate", ["time.sleep(0.004)"], "4 ms")
_lived(
    "publisher that is not activated", "on_activate", ["return TransitionCallbackReturn.SUCCESS"]
)
_lived(
    "configured with another value", "on_configure", ["self.offset = 0.75"], r"data 0\.5 → 0\.75"
)
_lived("value of an active node", "tick", ["value = 9.5"], r"data 0\.5 → 9\.5")
_lived("node that deactivates itself", "tick", ["if self.ticks == 5: self.trigger_deactivate()"])
_managed("transition not asked for", ["return"], CHANGE)
_managed("transitions in another order", ["steps.reverse()"], CHANGE)
_managed("transition left out", ["steps.pop(0)"], CHANGE)
_managed("transition asked for twice", ["steps.insert(0, steps[0])"], CHANGE)
