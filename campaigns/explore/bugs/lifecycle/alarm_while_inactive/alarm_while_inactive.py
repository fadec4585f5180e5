"""A managed node finds something at the moment at which it is activated, and nobody hears it."""

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import Empty, String


class Manager(Node):
    """Activates the monitor after a third of a second."""

    def __init__(self):
        super().__init__("manager")
        self.client = self.create_client(ChangeState, "monitor/change_state")
        self.steps = [Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE]
        self.timer = self.create_timer(0.15, self.step)

    def step(self):
        if self.client.service_is_ready():
            number = self.steps.pop(0)
            self.client.call_async(ChangeState.Request(transition=Transition(id=number)))
            if not self.steps:
                self.timer.cancel()


class Bumper(Node):
    """Is hit once."""

    def __init__(self):
        super().__init__("bumper")
        self.publisher = self.create_publisher(Empty, "hit", 10)
        self.timer = self.create_timer(0.3, self.hit)

    def hit(self):
        self.timer.cancel()
        self.publisher.publish(Empty())


class Monitor(LifecycleNode):
    """Says that the robot was hit."""

    def __init__(self):
        super().__init__("monitor")

    def on_configure(self, state):
        self.alarms = self.create_lifecycle_publisher(String, "alarm", 10)
        self.hits = self.create_subscription(Empty, "hit", self.on_hit, 10)
        return TransitionCallbackReturn.SUCCESS

    def on_hit(self, message):
        self.alarms.publish(String(data="hit"))


class KeepingMonitor(Monitor):
    """Says it when it can."""

    kept = False

    def on_hit(self, message):
        self.kept = not self.alarms.is_activated
        super().on_hit(message)

    def on_activate(self, state):
        done = super().on_activate(state)
        if self.kept:
            super().on_hit(Empty())
        return done
