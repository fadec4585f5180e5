"""Which of rclpy's tests cannot run in a simulation, and why."""

from __future__ import annotations

EXCLUDED: dict[str, str] = {}


def reason_for(test: str) -> str | None:
    """Return why a test is excluded, or None."""
    return EXCLUDED.get(test)
