"""Which of rclpy's tests cannot run in a simulation, and why: see ``docs/rclpy-tests.md``.

An excluded test is one that asks for what a simulation does otherwise on purpose. One that fails
because something is missing or wrong does not belong here.
"""

from __future__ import annotations

_TIME = (
    "sets ROS time by hand or through `/clock`; in a simulation the loop is the only source of "
    "time, for every clock"
)
_STILL = "reads a clock twice and expects time to have passed; simulated time passes in waits only"
_NEWEST = (
    "expects the newest task to run first, an accident of rclpy's list of tasks; here the oldest"
)
_WAIT_SET = (
    "expects the order in which rclpy walks one wait set (subscriptions before clients); here what "
    "came first runs first"
)
_CORES = "expects as many threads as the machine has cores; a run does not depend on the machine"
_NATIVE = "fails natively, too: it asks a node that does not exist"

EXCLUDED: dict[str, str] = {
    "test/test_action_server.py::TestActionServer::test_different_feedback_type_raises": _WAIT_SET,
    "test/test_action_server.py::TestActionServer::test_feedback": _WAIT_SET,
    "test/test_clock.py::TestClock::test_clock_now": _STILL,
    "test/test_clock.py::TestClock::test_triggered_time_jump_callbacks": _TIME,
    "test/test_clock.py::test_sleep_for_ros_time_enabled": _TIME,
    "test/test_executor.py::TestExecutor::test_create_task_dependent_coroutines": _NEWEST,
    "test/test_executor.py::TestExecutor::test_multi_threaded_executor_num_threads": _CORES,
    "test/test_logging.py::TestLogging::test_log_throttle_ros_clock": _TIME,
    "test/test_time_source.py::TestTimeSource::test_backwards_jump": _TIME,
    "test/test_time_source.py::TestTimeSource::test_forwards_jump": _TIME,
    "test/test_time_source.py::TestTimeSource::test_time_source_using_sim_time": _TIME,
    "test/test_type_description_service.py::TestTypeDescriptionService::"
    "test_get_type_description": _NATIVE,
}
