"""Where two runs first part, and why. Reads traces and bags; needs no ROS."""
