"""The adapter for processes: executables of any language that use rcl, run one callback at a time.

Each gets a library of ours that stands where its ROS middleware would be (``native/``), and talks
to the loop over a socket. It goes on when the loop says so, up to its next wait.
"""
