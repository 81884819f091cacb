"""Arrays ↔ ROS messages. Decoders take messages of rclpy and of bags alike: both have the same attributes."""
