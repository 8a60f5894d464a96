"""Other people's robots: a node in a ROS 2 graph, by rmw_zenoh's conventions, without ROS.

A room beside the bus, with a session of its own. The bus is ours from end to end: one schema, one table of topics, who
may say what. Here names, types, QoS and who speaks are the graph's, and none of the bus's rules can hold.
"""

from brakeline.messaging.ros2.rmw_names import LATCHED, SENSOR, BadRosName, GraphEntity, Qos
from brakeline.messaging.ros2.ros2_node import ROUTER, MessageTap, RosNode, RosPublisher, RosSettings

__all__ = [
    "LATCHED",
    "ROUTER",
    "SENSOR",
    "BadRosName",
    "GraphEntity",
    "MessageTap",
    "Qos",
    "RosNode",
    "RosPublisher",
    "RosSettings",
]
