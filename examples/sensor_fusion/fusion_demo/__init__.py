"""A small mobile robot: simulated sensors, an EKF, a planner and a path follower.

The mathematics (``ekf``, ``geodesy``, ``alignment``, ``course``, ``unicycle``) knows no ROS and can
be tested alone; the nodes wrap it.
"""
