"""The shape of ROS's ``message_filters``, of which there are no wheels."""


class _Filter:
    def __init__(self):
        self.callbacks = {}

    def registerCallback(self, callback, *arguments):  # noqa: N802  # as ROS names it
        self.callbacks[len(self.callbacks)] = (callback, arguments)
        return len(self.callbacks) - 1

    def signal(self, *messages):
        for callback, arguments in self.callbacks.values():
            callback(*messages, *arguments)


class Subscriber(_Filter):
    def __init__(self, node, type, topic):
        super().__init__()
        self.sub = node.create_subscription(type, topic, self.signal, 10)


class TimeSynchronizer(_Filter):
    def __init__(self, inputs, queue_size):
        super().__init__()
        self.queues = [{} for _ in inputs]
        self.input_connections = [
            one.registerCallback(self.add, queue)
            for one, queue in zip(inputs, self.queues, strict=True)
        ]

    def add(self, message, queue):
        stamp = message.header.stamp.sec, message.header.stamp.nanosec
        queue[stamp] = message
        if all(stamp in one for one in self.queues):
            self.signal(*(one[stamp] for one in self.queues))
