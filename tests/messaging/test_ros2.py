"""Names, tokens and bytes as rmw_zenoh has them, beside an implementation that others wrote; nodes of one graph."""

import contextlib
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

from brakeline.messaging.bus import Malformed, Unreachable
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.ros2 import LATCHED, SENSOR, BadRosName, GraphEntity, Qos, RosNode, RosSettings
from brakeline.messaging.ros2.cdr_messages import (
    Clock,
    DiagnosticArray,
    LaserScan,
    MarkerArray,
    Odometry,
    TFMessage,
    Twist,
    TwistStamped,
    decode,
    digest_of,
    encode,
    header,
    quaternion,
    seconds,
    time_of,
    twist,
    type_of,
    yaw_of,
)
from brakeline.messaging.ros2.rmw_attachment import Attachment, gid_of
from brakeline.messaging.ros2.rmw_names import NODE, PUBLISHER, SUBSCRIPTION, full_name, ros_type, topic_key
from tests.waiting import until

KINDS = (Clock, DiagnosticArray, LaserScan, MarkerArray, Odometry, TFMessage, Twist, TwistStamped)
HASH = "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
THEIRS = """
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


def test_names_tokens_and_attachments_are_those_of_another_implementation(tmp_path):
    text = THEIRS.format(hash=HASH)
    said = subprocess.run([sys.executable, "-c", text], env={"HOME": str(tmp_path)}, capture_output=True, check=True)
    theirs = json.loads(said.stdout)
    where = (7, "abc123", 0)
    assert GraphEntity(*where, 0, NODE, "/robot1", "brakeline").token == theirs["node"]
    ours = [
        GraphEntity(
            *where, 3, kind, "/robot1", "brakeline", "/robot1/cmd_vel", "geometry_msgs/msg/Twist", HASH, qos.token()
        )
        for kind in (PUBLISHER, SUBSCRIPTION)
        for qos in (Qos(), SENSOR, LATCHED)
    ]
    assert [entity.token for entity in ours] == theirs["ends"]
    assert [GraphEntity.parse(token) for token in theirs["ends"]] == ours
    assert topic_key(7, "/robot1/cmd_vel", "geometry_msgs/msg/Twist", HASH) == theirs["key"]
    assert Attachment(5, 123456789, bytes(range(16))).encode().hex() == theirs["attachment"]


def test_hashes_are_those_that_ros_has():
    known = {Twist: "9c45bf16", TwistStamped: "5f0fcd4f", Odometry: "3cc97dc7", LaserScan: "64c19139"}
    for kind, begins in known.items():
        assert digest_of(kind).startswith(f"RIHS01_{begins}")
    kilted = get_typestore(Stores.ROS2_KILTED)
    for kind in KINDS:
        assert kilted.hash_rihs01(type_of(kind)) == digest_of(kind)


def test_a_twist_is_52_bytes_of_little_endian_cdr():
    payload = encode(twist(0.25, -0.5))
    assert len(payload) == 52 and payload[:4] == bytes((0, 1, 0, 0))
    assert np.frombuffer(payload[4:], "<f8").tolist() == [0.25, 0.0, 0.0, 0.0, 0.0, -0.5]
    assert decode(Twist, payload) == twist(0.25, -0.5)


def test_a_global_id_is_the_tokens_hash_low_half_first():
    value = xxhash.xxh3_128_intdigest(b"@ros2_lv/0/a")
    assert gid_of("@ros2_lv/0/a") == (value & (2**64 - 1)).to_bytes(8, "little") + (value >> 64).to_bytes(8, "little")


def test_attachments_are_33_bytes_and_nothing_else():
    whole = Attachment(1, 2, bytes(16)).encode()
    assert len(whole) == 33 and Attachment.decode(whole) == Attachment(1, 2, bytes(16))
    for wrong in (b"", whole[:-1], whole + b"x", whole[:16] + b"\x0f" + whole[17:]):
        with pytest.raises(Malformed):
            Attachment.decode(wrong)


@given(st.sampled_from(KINDS), st.binary(max_size=200))
def test_any_bytes_are_a_message_or_malformed(kind, payload):
    for whole in (payload, b"\x00\x01\x00\x00" + payload):
        with contextlib.suppress(Malformed):
            assert type_of(type(decode(kind, whole))) == type_of(kind)


def test_a_sequence_without_end_is_malformed():
    endless = bytearray(encode(TFMessage(transforms=[])))
    endless[4:8] = (2**32 - 1).to_bytes(4, "little")
    with pytest.raises(Malformed):
        decode(TFMessage, bytes(endless))


def test_names_are_resolved_as_ros_does():
    assert full_name("scan") == "/scan" and full_name("scan", "/robot1") == "/robot1/scan"
    assert full_name("/tf", "/robot1") == "/tf"
    assert full_name("~/tube", "/robot1", "brakeline") == "/robot1/brakeline/tube"
    assert ros_type("geometry_msgs::msg::dds_::Twist_") == "geometry_msgs/msg/Twist"
    for wrong in ("", "a b", "1scan", "a//b", "scan*", "$", "a%b"):
        with pytest.raises(BadRosName):
            full_name(wrong)


@pytest.mark.parametrize("token", ["", "a/b", "@ros2_lv/0/z/0/0/NN/%/%", "@ros2_lv/x/z/0/0/NN/%/%/n", "@ros2_lv" * 9])
def test_what_is_no_token_is_said(token):
    with pytest.raises(BadRosName):
        GraphEntity.parse(token)


@given(st.floats(-3.1, 3.1), st.floats(0.0, 2e9))
def test_angles_and_times_come_back(yaw, moment):
    assert yaw_of(quaternion(yaw)) == pytest.approx(yaw, abs=1e-9)
    assert seconds(time_of(moment)) == pytest.approx(moment, abs=1e-6)


def test_no_rotation_has_no_yaw():
    nothing = quaternion(0.0)
    nothing.w = 0.0
    assert np.isnan(yaw_of(nothing))


@pytest.fixture
def nodes():
    """`nodes("name", namespace="/a")`: nodes of one graph; the first is its router."""
    endpoint, made = free_endpoint(), []

    def make(name, domain=0, namespace="/"):
        place = {"connect": (endpoint,)} if made else {"listen": (endpoint,)}
        made.append(RosNode(RosSettings(**place, domain=domain, namespace=namespace), name))
        return made[-1]

    yield make
    for node in reversed(made):
        node.close()


def test_nodes_hear_each_other_in_order_and_by_domain(nodes):
    nodes("router")
    sender, receiver, stranger = nodes("sender"), nodes("receiver"), nodes("stranger", domain=1)
    heard, astray = [], []
    receiver.subscribe("cmd_vel", Twist, lambda message: heard.append(message.linear.x), Qos(depth=100))
    stranger.subscribe("cmd_vel", Twist, astray.append)
    publisher = sender.publisher("cmd_vel", Twist)

    def greeted():
        publisher.put(twist(-1.0, 0.0))
        return heard

    until(greeted, "the first message", 20.0)
    for i in range(50):
        publisher.put(twist(float(i), 0.0))
    until(lambda: heard[-1] == 49.0, "the last message", 20.0)
    assert [value for value in heard if value >= 0.0] == [float(i) for i in range(50)]
    assert not astray
    with pytest.raises(TypeError, match="Twist"):
        publisher.put(header(0.0, "odom"))


def test_what_is_latched_is_there_for_who_comes_later(nodes):
    early = nodes("early")
    early.publisher("/tf_static", TFMessage, LATCHED).put(TFMessage(transforms=[]))
    heard = []
    nodes("late").subscribe("/tf_static", TFMessage, heard.append, LATCHED)
    until(lambda: heard, "the transforms of before", 20.0)


def test_the_graph_has_every_end_of_every_node_until_it_is_closed(nodes):
    watcher, robot = nodes("watcher"), nodes("robot", namespace="/a")
    robot.publisher("odom", Odometry)
    robot.subscribe("cmd_vel", Twist, print, SENSOR)
    wanted = {(NODE, "/a", "robot", "", ""), (NODE, "/", "watcher", "", "")}
    wanted |= {(PUBLISHER, "/a", "robot", "/a/odom", "nav_msgs/msg/Odometry")}
    wanted |= {(SUBSCRIPTION, "/a", "robot", "/a/cmd_vel", "geometry_msgs/msg/Twist")}

    def seen():
        return {(e.kind, e.namespace, e.node, e.topic, e.type) for e in watcher.graph()}

    until(lambda: seen() == wanted, "all of the graph", 20.0)
    robot.close()
    until(lambda: seen() == {(NODE, "/", "watcher", "", "")}, "the watcher alone", 20.0)


def test_what_is_no_message_is_lost_alone(nodes, caplog):
    router, node = nodes("router"), nodes("node")
    heard = []
    node.subscribe("cmd_vel", Twist, lambda message: heard.append(message.linear.x))
    publisher = router.publisher("cmd_vel", Twist)
    raw = router._session.declare_publisher(topic_key(0, "/cmd_vel", "geometry_msgs/msg/Twist", "any"))

    def broken():
        raw.put(b"\x00\x01\x00\x00rubbish")
        return node.rejected.count

    until(broken, "the rubbish", 20.0)
    publisher.put(twist(1.0, 0.0))
    until(lambda: heard == [1.0], "a message after it", 20.0)
    assert "/cmd_vel: Malformed: not a geometry_msgs/msg/Twist" in caplog.text


def test_no_router_is_said_with_what_to_do():
    begun = time.monotonic()
    with pytest.raises(Unreachable, match="rmw_zenohd"):
        RosNode(RosSettings(connect=(free_endpoint(),), patience=0.5), "alone")
    assert time.monotonic() - begun < 20.0


def test_an_endpoint_that_is_taken_is_said(nodes):
    taken = nodes("first").settings.listen
    with pytest.raises(Unreachable, match="cannot listen"):
        RosNode(RosSettings(listen=taken), "second")
