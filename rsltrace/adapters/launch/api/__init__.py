"""The part of ``launch`` and ``launch_ros`` that launch files use, for where ROS is not installed.

Classes of the same names and arguments; where ROS's would start processes, these note what would be
started. They are found under ROS's names only while a launch file is being read (``ros_modules``).
"""
