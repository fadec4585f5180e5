"""Nodes in which something keeps a callback from running; a comment marks the line to blame."""

import threading
import time

import message_filters
from geometry_msgs.msg import PointStamped, TransformStamped, TwistStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String, UInt64
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
OFTEN = QoSProfile(
    depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, deadline=Duration(seconds=0.05)
)
KEPT = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Source(Node):
    """Publishes every 100 ms."""

    def __init__(self):
        super().__init__("source")
        self.count = 0
        self.numbers = self.create_publisher(UInt64, "numbers", 10)
        self.quick = self.create_publisher(UInt64, "quick", BEST_EFFORT)
        self.early = self.create_publisher(String, "robot/names", 10)
        self.early.publish(String())
        self.stopping = self.create_publisher(String, "stopping", 10)
        self.create_timer(0.1, self.tick)
        self.stops = self.create_timer(0.1, self.until_stopped)
        self.create_timer(0.1, self.never_started, autostart=False)
        self.create_timer(100.0, self.rare)

    def tick(self):  # tick
        self.count += 1
        self.numbers.publish(UInt64(data=self.count))  # sends number
        self.quick.publish(UInt64(data=self.count))  # sends quick
        if self.count == 4:
            self.stops.cancel()

    def until_stopped(self):
        self.stopping.publish(String())

    def never_started(self):  # not started
        pass

    def rare(self):  # rare
        pass


class Listener(Node):
    """Its subscriptions do not fit."""

    def __init__(self):  # Listener
        super().__init__("listener")
        self.create_subscription(TwistStamped, "nothing", self.on_nothing, 10)
        self.create_subscription(String, "names", self.on_names, 10)
        self.create_subscription(UInt64, "quick", self.on_quick, 10)
        self.create_subscription(UInt64, "quick", self.on_often, OFTEN)
        self.create_subscription(UInt64, "numbers", self.on_kept, KEPT)
        self.create_subscription(String, "stopping", self.on_stopping, 10)
        self.client = self.create_client(Trigger, "reset")
        self.create_timer(0.3, self.join)
        self.joined = None

    def on_nothing(self, message):  # nobody
        pass

    def on_names(self, message):  # namespace
        pass

    def on_quick(self, message):  # reliability
        pass

    def on_often(self, message):  # deadline
        pass

    def on_kept(self, message):  # durability
        pass

    def on_stopping(self, message):
        pass

    def join(self):
        if self.joined is None:
            self.joined = self.create_subscription(String, "robot/names", self.on_joined, 10)

    def on_joined(self, message):  # joined late
        pass


class SimTime(Node):
    """Its clock follows /clock."""

    def __init__(self):  # SimTime
        super().__init__("sim_time")
        self.create_timer(0.1, self.by_clock)

    def by_clock(self):  # clock
        pass


class Worker(Node):
    """What it gets is lost, late or too much."""

    def __init__(self, name="worker"):  # Worker
        super().__init__(name)
        self.create_subscription(UInt64, "quick", self.on_quick, BEST_EFFORT)
        self.create_subscription(UInt64, "numbers", self.on_number, 2)

    def on_quick(self, message):
        pass

    def on_number(self, message):  # works
        pass


class Locked(Node):
    """Its thread keeps a lock."""

    def __init__(self):
        super().__init__("locked")
        self.lock = threading.Lock()
        self.create_subscription(UInt64, "numbers", self.on_number, 10)
        threading.Thread(target=self.work, daemon=True).start()

    def work(self):
        time.sleep(0.25)
        with self.lock:
            time.sleep(1000.0)

    def on_number(self, message):
        with self.lock:  # lock
            pass


class Caller(Node):
    """Its callback waits for a service that nobody offers."""

    def __init__(self):
        super().__init__("caller")
        self.client = self.create_client(Trigger, "nobody", callback_group=ReentrantCallbackGroup())
        self.create_subscription(UInt64, "numbers", self.on_number, 10)
        self.create_timer(0.25, self.on_time)

    def on_number(self, message):
        if message.data == 3:
            self.client.call(Trigger.Request())  # service

    def on_time(self):
        pass


class Sleeper(Node):
    """Its timer sleeps too long."""

    def __init__(self):
        super().__init__("sleeper")
        self.create_subscription(UInt64, "numbers", self.on_number, 10)
        self.create_timer(0.45, self.on_time)

    def on_number(self, message):
        pass

    def on_time(self):  # sleeps
        time.sleep(0.3)


class Broken(Node):
    """Its constructor raises."""

    def __init__(self):
        super().__init__("broken")
        raise ValueError("no calibration")  # constructor


class Failing(Node):
    """Its callback raises."""

    def __init__(self):
        super().__init__("failing")
        self.create_subscription(UInt64, "numbers", self.on_number, 10)

    def on_number(self, message):
        if message.data == 3:
            raise ValueError("three")  # raises


class Fusion(Node):
    """Two sensors whose stamps never match."""

    def __init__(self):
        super().__init__("fusion")
        self.point = self.create_publisher(PointStamped, "point", 10)
        self.twist = self.create_publisher(TwistStamped, "twist", 10)
        inputs = [
            message_filters.Subscriber(self, PointStamped, "point"),
            message_filters.Subscriber(self, TwistStamped, "twist"),
        ]
        self.both = message_filters.TimeSynchronizer(inputs, 10)
        self.both.registerCallback(self.fuse)
        self.create_timer(0.1, self.send)

    def send(self):
        point, twist = PointStamped(), TwistStamped()
        point.header.stamp = self.get_clock().now().to_msg()
        twist.header.stamp = (self.get_clock().now() + Duration(nanoseconds=5)).to_msg()
        self.point.publish(point)
        self.twist.publish(twist)

    def fuse(self, point, twist):  # stamps
        pass


class Mapper(Node):
    """Says what tf2 says of a transform that comes late, and of one that never comes."""

    def __init__(self):
        super().__init__("mapper")
        self.transforms = self.create_publisher(TFMessage, "/tf", 10)
        self.create_subscription(PointStamped, "point", self.on_point, 10)
        self.create_subscription(TwistStamped, "twist", self.on_twist, 10)
        self.create_timer(0.35, self.locate)

    def locate(self):
        transform = TransformStamped(child_frame_id="base")
        transform.header.frame_id = "odom"
        transform.header.stamp = self.get_clock().now().to_msg()
        self.transforms.publish(TFMessage(transforms=[transform]))

    def on_point(self, message):
        text = "Lookup would require extrapolation into the future.  Requested time 0.5 but the "
        text += "latest data is at time 0.35, when looking up transform from frame [base] to "
        text += "frame [odom]"
        if message.header.stamp.nanosec > 400_000_000:
            self.get_logger().warning(text)  # extrapolation

    def on_twist(self, message):
        text = '"lidar" passed to lookupTransform argument source_frame does not exist.'
        self.get_logger().warning(text)  # frame
