"""ROS packages in source folders, as nobody has built them: their interfaces and their shares."""
