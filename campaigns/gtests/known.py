"""Which tests of rclcpp and of what builds on it go another way in a simulation, and why."""

KNOWN = {
    "test_executor TestExecutor.spin_*once_*": (
        "expects a timer before a message that came earlier; here the order is the loop's"
    ),
    "test_executors TestExecutors/*.testRaceConditionAddNode": (
        "its threads compute until another one sets a flag; here a thread runs until it waits"
    ),
    "test_executors_busy_waiting TestBusyWaiting/MultiThreadedExecutor.test_spin": (
        "counts how often an executor looks before another thread runs"
    ),
    "test_events_executor TestEventsExecutor.spin_once_max_duration_timer": (
        "expects what a node sends itself before it waits; here it arrives when it waits"
    ),
    "test_rate TestRate.*": "expects more than the period to pass; here exactly that passes",
    "test_qos_event TestQosEvent.test_on_new_event_callback": (
        "expects to be called for earlier events at once; here it is when it waits"
    ),
}
"""By ``executable test``, as a pattern of the shell."""
