"""ROS 2 nodes: thin shells around the rooms that do the work."""
