"""ROS 2 nodes of pcw_description; the only place of this package where rclpy is imported."""
