"""ROS 2 nodes: thin shells around the other rooms. With ``messages`` the only room that imports rclpy."""

import os

# Must precede the import of PyTorch: with few cores, spinning idle threads slow down working ones.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
