"""Compare names, tokens and bytes with another implementation of rmw_zenoh, and connect nodes in one graph."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys.stores import Stores, get_typestore

from brakeline.errors import BadRosName, Malformed, Unreachable
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.ros2 import ALL_LATCHED, LATCHED, SENSOR, GraphEntity, Qos, RosNode, RosSettings
from brakeline.messaging.ros2 import cdr_messages as cdr
from brakeline.messaging.ros2.rmw_names import (
    NODE,
    PUBLISHER,
    SUBSCRIPTION,
    attachment,
    dds_type,
    full_name,
    gid_of,
    topic_key,
)
from tests.actors.ros2.test_ros_inputs import transform
from tests.waiting import until

KINDS = (
    cdr.Clock,
    cdr.DiagnosticArray,
    cdr.LaserScan,
    cdr.MarkerArray,
    cdr.Odometry,
    cdr.TFMessage,
    cdr.Twist,
    cdr.TwistStamped,
)
HASH = "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
REFERENCE_SCRIPT = """
import json
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

kind, hash_ = ros2_to_dds_type("geometry_msgs/msg/Twist"), "{hash}"
node = NodeEntity(7, "abc123", 0, "brakeline", "/robot1")
qos = QosProfile(reliability=QosReliability.BEST_EFFORT, history_depth=5)
latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
ends = [
    EndpointEntity(node, 3, which, "/robot1/cmd_vel", kind, hash_, profile.encode())
    for which in (EntityKind.PUBLISHER, EntityKind.SUBSCRIPTION)
    for profile in (QosProfile(), qos, latched)
]
print(json.dumps({{
    "node": node_liveliness_keyexpr(node),
    "ends": [endpoint_liveliness_keyexpr(end) for end in ends],
    "key": topic_keyexpr(7, "/robot1/cmd_vel", kind, hash_),
    "attachment": Attachment(5, 123456789, bytes(range(16))).to_bytes().hex(),
}}))
"""


def test_names_tokens_and_attachments_agree_with_another_implementation(tmp_path):
    text = REFERENCE_SCRIPT.format(hash=HASH)
    done = subprocess.run([sys.executable, "-c", text], env={"HOME": str(tmp_path)}, capture_output=True, check=True)
    reference = json.loads(done.stdout)
    where = (7, "abc123", 0)
    assert GraphEntity(*where, 0, NODE, "/robot1", "brakeline").token == reference["node"]
    ours = [
        GraphEntity(
            *where, 3, kind, "/robot1", "brakeline", "/robot1/cmd_vel", "geometry_msgs/msg/Twist", HASH, qos.token()
        )
        for kind in (PUBLISHER, SUBSCRIPTION)
        for qos in (Qos(), SENSOR, LATCHED)
    ]
    assert [entity.token for entity in ours] == reference["ends"]
    assert topic_key(7, "/robot1/cmd_vel", "geometry_msgs/msg/Twist", HASH) == reference["key"]
    assert attachment(5, 123456789, bytes(range(16))).hex() == reference["attachment"]


def test_type_hashes_agree_with_ros():
    expected = {
        cdr.Twist: "9c45bf16",
        cdr.TwistStamped: "5f0fcd4f",
        cdr.Odometry: "3cc97dc7",
        cdr.LaserScan: "64c19139",
    }
    for kind, begins in expected.items():
        assert cdr.digest_of(kind).startswith(f"RIHS01_{begins}")
    kilted = get_typestore(Stores.ROS2_KILTED)
    for kind in KINDS:
        assert kilted.hash_rihs01(cdr.type_of(kind)) == cdr.digest_of(kind)


def test_a_twist_is_52_bytes_of_little_endian_cdr():
    payload = cdr.encode(cdr.twist(0.25, -0.5))
    assert len(payload) == 52 and payload[:4] == bytes((0, 1, 0, 0))
    assert np.frombuffer(payload[4:], "<f8").tolist() == [0.25, 0.0, 0.0, 0.0, 0.0, -0.5]
    assert cdr.decode(cdr.Twist, payload) == cdr.twist(0.25, -0.5)


def test_a_global_id_is_the_hash_of_the_token_low_half_first():
    value = xxhash.xxh3_128_intdigest(b"@ros2_lv/0/a")
    assert gid_of("@ros2_lv/0/a") == (value & (2**64 - 1)).to_bytes(8, "little") + (value >> 64).to_bytes(8, "little")


def test_a_sequence_with_too_many_elements_is_malformed():
    endless = bytearray(cdr.encode(cdr.TFMessage(transforms=[])))
    endless[4:8] = (2**32 - 1).to_bytes(4, "little")
    with pytest.raises(Malformed):
        cdr.decode(cdr.TFMessage, bytes(endless))


def test_topic_names_resolve_as_in_ros():
    assert full_name("scan") == "/scan" and full_name("scan", "/robot1") == "/robot1/scan"
    assert full_name("/tf", "/robot1") == "/tf"
    assert full_name("~/tube", "/robot1", "brakeline") == "/robot1/brakeline/tube"
    for invalid in ("", "a b", "1scan", "a//b", "scan*", "$", "a%b"):
        with pytest.raises(BadRosName):
            full_name(invalid)


@given(st.floats(-3.1, 3.1), st.floats(0.0, 2e9))
def test_angles_and_times_survive_a_conversion_and_what_is_no_rotation_has_no_yaw(yaw, moment):
    rotation = cdr.quaternion(yaw)
    assert cdr.yaw_of(rotation) == pytest.approx(yaw, abs=1e-9)
    rotation.w = rotation.z = 0.0
    assert np.isnan(cdr.yaw_of(rotation))
    assert cdr.seconds(cdr.time_of(moment)) == pytest.approx(moment, abs=1e-6)


@pytest.fixture
def nodes():
    """Return a function that makes nodes of one graph; the first one is the router."""
    endpoint, made = free_endpoint(), []

    def make(name, domain=0, namespace="/"):
        place = {"connect": (endpoint,)} if made else {"listen": (endpoint,)}
        made.append(RosNode(RosSettings(**place, domain=domain, namespace=namespace), name))
        return made[-1]

    yield make
    for node in reversed(made):
        node.close()


def test_nodes_of_one_domain_receive_messages_in_order(nodes):
    nodes("router")
    sender, receiver, stranger = nodes("sender"), nodes("receiver"), nodes("stranger", domain=1)
    received, misdirected = [], []
    receiver.subscribe("cmd_vel", cdr.Twist, lambda message: received.append(message.linear.x), Qos(depth=100))
    stranger.subscribe("cmd_vel", cdr.Twist, misdirected.append)
    publisher = sender.publisher("cmd_vel", cdr.Twist)

    def first_arrived():
        publisher.put(cdr.twist(-1.0, 0.0))
        return received

    until(first_arrived, "the first message", 20.0)
    for i in range(50):
        publisher.put(cdr.twist(float(i), 0.0))
    until(lambda: received[-1] == 49.0, "the last message", 20.0)
    assert [value for value in received if value >= 0.0] == [float(i) for i in range(50)]
    assert not misdirected
    with pytest.raises(TypeError, match="Twist"):
        publisher.put(cdr.header(0.0, "odom"))


def test_a_later_subscriber_gets_latched_messages(nodes):
    early = nodes("early")
    early.publisher("/tf_static", cdr.TFMessage, LATCHED).put(cdr.TFMessage(transforms=[]))
    received = []
    nodes("late").subscribe("/tf_static", cdr.TFMessage, received.append, LATCHED)
    until(lambda: received, "the transforms of before", 20.0)


def test_a_later_subscriber_gets_the_static_transforms_of_every_publisher(nodes):
    """A robot has several: each of its drivers publishes the place of its sensor once."""
    frames, received = {"laser", "camera", "imu", "sonar"}, []
    nodes("router")
    for frame in frames:
        message = cdr.TFMessage(transforms=[transform("base", frame)])
        nodes(frame).publisher("/tf_static", cdr.TFMessage, LATCHED).put(message)
    time.sleep(0.5)  # all have found each other: then their messages arrive together
    nodes("late").subscribe("/tf_static", cdr.TFMessage, received.append, ALL_LATCHED)
    until(lambda: {m.transforms[0].child_frame_id for m in received} == frames, lambda: f"all of {received}", 20.0)


def test_the_graph_lists_all_entities_of_a_node_until_it_is_closed(nodes):
    watcher, robot = nodes("watcher"), nodes("robot", namespace="/a")
    robot.publisher("odom", cdr.Odometry)
    robot.subscribe("cmd_vel", cdr.Twist, print, SENSOR)
    wanted = {(NODE, "%a", "robot"), (NODE, "%", "watcher")}
    wanted |= {(PUBLISHER, "%a", "robot", "%a%odom", dds_type("nav_msgs/msg/Odometry"))}
    wanted |= {(SUBSCRIPTION, "%a", "robot", "%a%cmd_vel", dds_type("geometry_msgs/msg/Twist"))}

    def seen():
        tokens = [str(reply.ok.key_expr).split("/") for reply in watcher._session.liveliness().get("@ros2_lv/0/**")]
        return {(token[5], *token[7:11]) for token in tokens}

    until(lambda: seen() == wanted, "all of the graph", 20.0)
    robot.close()
    until(lambda: seen() == {(NODE, "%", "watcher")}, "the watcher alone", 20.0)


def test_an_invalid_message_does_not_stop_the_next_one(nodes, caplog):
    router, node = nodes("router"), nodes("node")
    received = []
    node.subscribe("cmd_vel", cdr.Twist, lambda message: received.append(message.linear.x))
    publisher = router.publisher("cmd_vel", cdr.Twist)
    raw = router._session.declare_publisher(topic_key(0, "/cmd_vel", "geometry_msgs/msg/Twist", "any"))

    def send_invalid():
        raw.put(b"\x00\x01\x00\x00rubbish")
        return node.rejected.count

    until(send_invalid, "the invalid message", 20.0)
    publisher.put(cdr.twist(1.0, 0.0))
    until(lambda: received == [1.0], "a message after it", 20.0)
    assert "/cmd_vel: Malformed: not a geometry_msgs/msg/Twist" in caplog.text


def test_without_a_router_the_error_says_what_to_do_and_a_taken_endpoint_is_one(nodes):
    begun = time.monotonic()
    with pytest.raises(Unreachable, match="rmw_zenohd"):
        RosNode(RosSettings(connect=(free_endpoint(),), patience=0.5), "alone")
    assert time.monotonic() - begun < 20.0
    taken = nodes("first").settings.listen
    with pytest.raises(Unreachable, match="cannot listen"):
        RosNode(RosSettings(listen=taken), "second")
