"""The filter between a ROS 2 robot's raw commands and its base."""
