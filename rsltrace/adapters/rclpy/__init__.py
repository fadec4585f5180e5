"""The in-process middleware behind rclpy's C-extension boundary; the only place that knows ROS.

Every rclpy module reaches the middleware through one object, ``rclpy_implementation``. This
package puts an object of ours there (``boundary.py``) whose entity classes live in this process,
so that all of rclpy's Python layer and all user code stay unmodified. No DDS participant, no
socket, no thread.
"""
