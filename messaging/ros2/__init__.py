"""A node in a ROS 2 graph, by the conventions of rmw_zenoh, without ROS.

The node has a Zenoh session of its own, beside the bus. The bus has one schema, one table of topics, and rules about
its senders. In a ROS graph the names, types, QoS and senders are not ours, so those rules cannot hold here.
"""

from brakeline.messaging.ros2.rmw_names import ALL_LATCHED, LATCHED, SENSOR, GraphEntity, Qos
from brakeline.messaging.ros2.ros2_node import ROUTER, MessageTap, RosNode, RosPublisher, RosSettings

__all__ = [
    "ALL_LATCHED",
    "LATCHED",
    "ROUTER",
    "SENSOR",
    "GraphEntity",
    "MessageTap",
    "Qos",
    "RosNode",
    "RosPublisher",
    "RosSettings",
]
