"""ROS 2 nodes: thin shells around the rooms that do the work."""

import os

# Before PyTorch is loaded: on few cores threads that spin while they wait take the time of those that work.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
