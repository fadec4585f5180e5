"""The discrete-event simulation: pure, in integer nanoseconds, knowing neither rclpy nor files.

``loop.py`` reads like the specification in ``docs/design.md``; the other modules are one noun each.
"""
