"""Which of rclpy's tests cannot run in a simulation: ``docs/qualification/rclpy-tests.md``.

An excluded test is one that asks for what a simulation does otherwise on purpose. One that fails
because something is missing or wrong does not belong here.
"""

from __future__ import annotations

_NATIVE = "fails natively, too: it asks a node that does not exist"

_HERE: dict[str, str] = {
    "test/test_type_description_service.py::TestTypeDescriptionService::"
    "test_get_type_description": _NATIVE,
}

_ONE = "expects a response and a message in one wait; here a wait hands over one thing"
_STANDS = "expects that time passes between two statements; in a process it stands still there"
_NEWER = "fails natively, too: it sets what the compiled rclpy of the wheels does not have"

_PROCESS: dict[str, str] = {
    "test/test_action_server.py::TestActionServer::test_different_feedback_type_raises": _ONE,
    "test/test_action_server.py::TestActionServer::test_feedback": _ONE,
    "test/test_clock.py::TestClock::test_clock_now": _STANDS,
    "test/test_destruction_order.py::test_destruction_order": _NEWER,
    "test/test_type_description_service.py::TestTypeDescriptionService::"
    "test_get_type_description": _NATIVE,
}
EXCLUDED = {"simulation": _HERE, "process": _PROCESS}
"""By where the tests run: in rsltrace's process, or in processes of the run."""
