"""Filter the commands of a ROS 2 robot between its raw commands and its base."""
