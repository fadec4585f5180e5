"""A client asks again when no answer came in time: the server serves the first request, too."""

from rclpy.node import Node
from std_msgs.msg import Int32
from test_msgs.srv import BasicTypes


class Dispenser(Node):
    """Dispenses a pill for every request."""

    def __init__(self):
        super().__init__("dispenser")
        self.pills = 0
        self.publisher = self.create_publisher(Int32, "pills", 10)
        self.create_service(BasicTypes, "dispense", self.dispense)

    def dispense(self, request, response):
        self.pills += 1
        self.publisher.publish(Int32(data=self.pills))
        return response


class RememberingDispenser(Dispenser):
    """Knows a request that it has served."""

    served = -1

    def dispense(self, request, response):
        if request.int32_value == self.served:
            return response
        self.served = request.int32_value
        return super().dispense(request, response)


class Nurse(Node):
    """Wants one pill."""

    def __init__(self):
        super().__init__("nurse")
        self.client = self.create_client(BasicTypes, "dispense")
        self.timer = self.create_timer(0.1, self.ask)

    def ask(self):
        request = BasicTypes.Request(int32_value=1)
        self.client.call_async(request).add_done_callback(lambda done: self.timer.cancel())
