"""ROS 2 nodes: thin shells around the other rooms. With ``messages`` the only room that imports rclpy."""

import os

# Before PyTorch is loaded: with few cores, waiting threads that spin take time from those that work.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
