"""The clock that a node's own work goes by.

Timers of rclpy follow ROS time, which stands still under ``use_sim_time`` until something publishes ``/clock``, and
again when that ends. What watches inputs, reports health and commands the robot must go on then.
"""

from __future__ import annotations

from rclpy.clock import Clock, ClockType

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""Monotonic time, whatever happens to ROS time."""
