"""What an attacker on the bus can do, with real routers and sessions: with keys nothing, without them all of it.

Each attack is made twice: on a bus without keys, where it has to succeed (else it would prove nothing), and with them.
The attacker has an actor's certificate, for the actors are the many, and speaks Zenoh: no code of ours holds it back.
"""

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
import zenoh
from cryptography import x509

from brakeline.errors import BadKeys, BusError, NoReply, Unreachable
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging import topics
from brakeline.messaging.bus import Bus, BusSettings, Sample, configuration
from brakeline.messaging.bus.access_control import MOST_ROBOTS, grants
from brakeline.messaging.bus.bus_settings import local
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.bus.identity import names_in
from brakeline.messaging.free_ports import HERE, free_endpoint
from brakeline.messaging.process_runtime import Process
from tests.messaging.keyring import keyring
from tests.messaging.programs import answers
from tests.waiting import until

JOINED = 0.3  # s that a declaration may take to reach everybody on this machine


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keyring(tmp_path_factory.mktemp("keys") / "keys")


class System:
    """A router and honest clients, on loopback, with keys or without."""

    def __init__(self, keys: Path | None) -> None:
        self.keys = keys
        self.endpoint = free_endpoint() if keys is None else free_endpoint("tls")
        self._buses = {"launcher": Bus(BusSettings(listen=(self.endpoint,), keys=keys), "launcher")}
        self._sessions: list[zenoh.Session] = []

    def settings(self) -> BusSettings:
        return BusSettings(connect=(self.endpoint,), keys=self.keys, patience=3.0)

    def join(self, source: str) -> Bus:
        """Return the bus of this process, which joins if it has not yet."""
        if source not in self._buses:
            self._buses[source] = Bus(self.settings(), source)
        return self._buses[source]

    def attacker(self, name: str = "actor-1") -> zenoh.Session:
        """A session under a certificate, and nothing of ours between it and the wire."""
        self._sessions.append(zenoh.open(configuration(self.settings(), name)))
        return self._sessions[-1]

    def close(self) -> None:
        for session in self._sessions:
            session.close()  # type: ignore[no-untyped-call]
        for bus in reversed(self._buses.values()):
            bus.close()


@pytest.fixture(params=[False, True], ids=["without keys", "with keys"])
def system(request: pytest.FixtureRequest, keys: Path) -> Iterator[System]:
    made = System(keys if request.param else None)
    yield made
    made.close()


@pytest.fixture
def secure(keys: Path) -> Iterator[System]:
    made = System(keys)
    yield made
    made.close()


@contextmanager
def heard(listener: Bus, topic: topics.Topic) -> Iterator[list[Sample]]:
    got: list[Sample] = []
    listener.subscribe(topic, got.append)
    time.sleep(JOINED)
    yield got


CASES = [
    # what only one role may say, who says it, who hears it, and the keys at which somebody else tries to
    (topics.MODEL, "certify", "safety", ("model/ground/certify", "model/ground/actor-1")),
    (topics.WEIGHTS, "learner", "actor-0", ("weights/ground",)),
    (topics.FLOW, "learner", "actor-0", ("flow/ground",)),
    (topics.STEP, "actor-0", "learner", ("step/ground/actor-0", "step/ground/actor-2", "step/ground/actor-10")),
    (topics.LOGGED, "feeder", "learner", ("logged/ground/actor-1",)),
    (topics.HEALTH, "actor-0", "recorder", ("health/actor-0", "health/safety")),
]


def test_what_one_role_may_say_nobody_else_can(system: System) -> None:
    attacker = system.attacker()
    with ExitStack() as stack:
        got = [stack.enter_context(heard(system.join(listener), topic)) for topic, _, listener, _ in CASES]
        for (topic, owner, _, keys_tried), samples in zip(CASES, got, strict=True):
            for key in keys_tried:
                attacker.put(f"brakeline/{key}", b"evil")
            source = {"logged": "actor-0", "step": "actor-0.3"}.get(topic.name)  # a robot of the actor
            names = {} if source is None else {"source": source}
            names |= {"robot": "ground"} if "{robot}" in topic.key else {}
            system.join(owner).publisher(topic, **names).put(topic.message())
            until(lambda: any(sample.payload != b"evil" for sample in samples), topic.name)  # noqa: B023
            if system.keys is None:
                until(lambda: len(samples) == 1 + len(keys_tried), topic.name)  # noqa: B023
        time.sleep(JOINED)
        for (topic, _, _, keys_tried), samples in zip(CASES, got, strict=True):
            evil = [sample.payload == b"evil" for sample in samples].count(True)
            assert evil == (0 if system.keys else len(keys_tried)), topic.name


def test_a_second_queryable_answers_nobody(system: System) -> None:
    """It is there first, and from then on, and claims to answer for all robots; also from where there is no service."""

    def evil(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"allowed")

    attacker, asker = system.attacker(), system.join("actor-0")
    for key in ("brakeline/safety/*/decide/*", "brakeline/safety/*/decide/*/*"):  # of all, and of each by itself
        attacker.declare_queryable(key, evil, complete=True)
    time.sleep(JOINED)
    if system.keys is None:
        assert asker.ask(topics.DECIDE, b"?", 10.0, robot="ground") == b"allowed"
        return
    with pytest.raises(NoReply):
        asker.ask(topics.DECIDE, b"?", 2.0, robot="ground")
    system.join("safety").serve(topics.DECIDE, lambda payload, asker: b"verified")
    until(lambda: answers(asker, timeout=10.0), "the service is known")
    assert {asker.ask(topics.DECIDE, b"?", 10.0, robot="ground") for _ in range(200)} == {b"verified"}


WILD = {  # by role: keys that a client of the role may not publish at, and one that it may
    "client": (("log/client.$*", "log/*", "log/**", "log/client.x", "health/client.$*", "health/*"), "log/client"),
    "viewer": (("log/viewer.$*", "log/*", "health/viewer.$*", "health/*"), "log/viewer"),
    "actor-1": (("log/actor-1.$*", "step/ground/actor-1.$*", "step/ground/*", "step/**", "log/*"), "log/actor-1"),
}


def test_a_key_with_a_wildcard_reaches_nobody(system: System) -> None:
    """A publication at a wildcard reaches the subscribers of all keys that it matches; each one would refuse it."""
    listener = system.join("recorder")
    with ExitStack() as stack:
        kinds = (topics.LOG, topics.HEALTH, topics.STEP)
        got, signs, steps = (stack.enter_context(heard(listener, topic)) for topic in kinds)
        for name, (keys, honest) in WILD.items():
            attacker, before = system.attacker(name), listener.rejected.count
            for key in keys:
                attacker.put(f"brakeline/{key}", b"evil")
            attacker.put(f"brakeline/{honest}", b"end")
            until(lambda: any(sample.payload == b"end" and sample.key == honest for sample in got))  # noqa: B023
            time.sleep(JOINED)
            assert not any("*" in sample.key for sample in (*got, *signs, *steps))
            assert (listener.rejected.count > before) == (system.keys is None)


def test_nobody_asks_under_the_name_of_another(system: System) -> None:
    """The name in the key of a query decides whose turn it is, for whom a token is, and who joins the learner."""
    attacker = system.attacker("actor-1")
    askers: list[str] = []
    for source, topic in (("safety", topics.DECIDE), ("learner", topics.JOIN)):
        system.join(source).serve(topic, lambda payload, asker: askers.append(asker) or b"answer")
    time.sleep(JOINED)
    for root in ("safety/ground/decide", "learner/ground/join"):
        for asker in ("actor-0", "actor-10", "actor-1.0", "client", "*", "actor-$*", "actor-1"):
            list(attacker.get(f"brakeline/{root}/{asker}", timeout=2.0))
    assert {*askers} == ({"actor-1"} if system.keys else {"actor-0", "actor-10", "actor-1.0", "client", "actor-1"})


def test_nobody_poses_as_alive_under_another_name(secure: System) -> None:
    viewer, attacker = secure.join("viewer"), secure.attacker("viewer")
    names = ("viewer.$*", "actor-0", "viewer.true")
    tokens = [attacker.liveliness().declare_token(f"brakeline/alive/{name}") for name in names]
    until(lambda: "viewer.true" in viewer.living())
    assert not viewer.living() & {"viewer.$*", "actor-0"} and len(tokens) == 3


def test_an_eavesdropper_on_everything_hears_nothing(system: System) -> None:
    overheard: list[str] = []
    attacker = system.attacker()
    for key in ("**", "brakeline/**", "*/step/**", "brakeline/step/*/*", "brakeline/health/*"):
        attacker.declare_subscriber(key, lambda sample: overheard.append(str(sample.key_expr)))
        attacker.declare_queryable(key, lambda query: overheard.append(str(query.key_expr)))
    attacker.liveliness().declare_subscriber("**", lambda sample: overheard.append(str(sample.key_expr)), history=True)
    time.sleep(JOINED)
    actor = system.join("actor-0")
    with heard(system.join("recorder"), topics.STEP) as got:
        actor.publisher(topics.STEP, robot="ground").put(pb.Step())
        actor.publisher(topics.HEALTH).put(pb.Health())
        with pytest.raises(BusError):
            actor.ask(topics.DECIDE, b"?", 0.5, robot="ground")
        until(lambda: len(got) >= 1)
    time.sleep(JOINED)
    assert bool(overheard) == (system.keys is None), overheard


def test_who_has_no_certificate_of_this_authority_cannot_connect(secure: System, keys: Path, tmp_path: Path) -> None:
    rogue = keyring(tmp_path / "rogue", "actor-0")  # the right name, from somebody else
    mixed = keyring(tmp_path / "mixed", "actor-0")  # it knows our authority, and shows its own
    (mixed / "ca.pem").write_bytes((keys / "ca.pem").read_bytes())
    for folder in (rogue, mixed):
        with pytest.raises(Unreachable, match="one authority"):
            Bus(BusSettings(connect=(secure.endpoint,), keys=folder, patience=1.5), "actor-0")
    plain = secure.endpoint.replace("tls/", "tcp/")
    with pytest.raises(Unreachable):
        Bus(BusSettings(connect=(plain,), patience=1.5), "actor-0")
    assert secure.join("actor-0").connected


def test_nobody_with_a_clients_certificate_is_taken_for_a_router(keys: Path) -> None:
    """In front of the router, or in its place: a client looks at what it is shown."""
    endpoint = free_endpoint("tls")
    config = configuration(BusSettings(listen=(endpoint,), keys=keys), "launcher")
    for name in ("certificate", "private_key"):
        file = keys / ("actor-1.pem" if name == "certificate" else "actor-1.key")
        config.insert_json5(f"transport/link/tls/listen_{name}", json.dumps(str(file)))
    impostor = zenoh.open(config)
    with pytest.raises(Unreachable):
        Bus(BusSettings(connect=(endpoint,), keys=keys, patience=1.5), "actor-0")
    impostor.close()  # type: ignore[no-untyped-call]
    with pytest.raises(BadKeys, match="cannot be a router"):
        Bus(BusSettings(listen=(endpoint,), keys=keys), "actor-1")


def test_a_name_that_is_struck_out_can_do_nothing(keys: Path, tmp_path: Path) -> None:
    router_keys = tmp_path / "keys"
    shutil.copytree(keys, router_keys)
    names = (keys / "names").read_text().split()
    (router_keys / "names").write_text("\n".join(name for name in names if name != "actor-1"))
    system = System(router_keys)
    revoked, honest = system.join("actor-1"), system.join("actor-0")
    with heard(system.join("learner"), topics.STEP) as got:
        revoked.publisher(topics.STEP, robot="ground").put(pb.Step())
        honest.publisher(topics.STEP, robot="ground").put(pb.Step())
        until(lambda: len(got) == 1)
        time.sleep(JOINED)
        assert [sample.key for sample in got] == ["step/ground/actor-0"]
    system.close()


def answered(speaker: Bus, topic: topics.Topic, **robot: str) -> bool:
    try:
        return speaker.ask(topic, b"?", 5.0, **robot) == b"answer"
    except BusError:  # as yet
        return False


def test_the_table_works_with_keys(secure: System) -> None:
    """Whoever the table lets speak is heard by all whom it lets listen: nothing honest is shut out."""
    for topic in topics.TOPICS:
        listeners, speakers = (
            [secure.join("actor-0" if role == "actor" else role) for role in roles if role not in left_out]
            for roles, left_out in (
                (topic.listeners, {"launcher", "router"}),
                (topic.publishers, {"launcher", "router", "viewer"}),
            )
        )
        robot = {"robot": "ground"} if "{robot}" in topic.key else {}
        if topic.delivery is topics.Delivery.QUERY:
            for listener in listeners:
                listener.serve(topic, lambda payload, asker: b"answer", **({} if topic is topics.DECIDE else robot))
            for speaker in speakers:
                until(partial(answered, speaker, topic, **robot), f"the speaker knows a listener of {topic.name}")
            assert {speaker.ask(topic, b"?", 5.0, **robot) for speaker in speakers} == {b"answer"}, topic.name
            continue
        got: list[list[Sample]] = [[] for _ in listeners]
        for listener, samples in zip(listeners, got, strict=True):
            listener.subscribe(topic, samples.append, **robot)
        time.sleep(JOINED)
        for speaker in speakers:
            speaker.publisher(topic, **robot).put(topic.message())
        until(lambda: all(len(samples) == len(speakers) for samples in got), topic.name)  # noqa: B023


def test_who_looks_on_knows_who_lives(secure: System) -> None:
    viewer, actor = secure.join("viewer.watch-1"), secure.join("actor-0")
    until(lambda: {"launcher", "viewer.watch-1", "actor-0"} <= viewer.living())
    known: list[frozenset[str]] = []  # a machine that stalls for a second lets the question run out
    until(lambda: known.append(actor.living()) or len(known[-1]) > 0)
    assert known[-1] == {"actor-0"}, "and an actor need not"
    actor.close()
    until(lambda: "actor-0" not in viewer.living())


@pytest.mark.parametrize("role", sorted({*topics.ROLES} - {"router"}))
def test_a_role_is_granted_what_the_table_says_and_no_more(role: str) -> None:
    granted = grants(f"{role}-7", "brakeline")
    keys = {key for flow, messages, key in granted if flow == "ingress" and "put" in messages}
    own = {topic for topic in topics.TOPICS if role in topic.publishers and topic.delivery is not topics.Delivery.QUERY}
    assert {key.split("/")[1] for key in keys} == {topic.key.split("/")[0] for topic in own}
    for key in keys:
        root = key.split("/")[1]
        if root not in ("weights", "flow", "metrics", "logged"):
            assert "*" not in key.split("/")[-1], "under exact names"
            robots = {f"{role}-7.{number}" for number in range(MOST_ROBOTS)} if role in topics.SIMULATORS else set()
            assert key.split("/")[-1] in {f"{role}-7"} | robots, "under its own name"
    answers = {key for _, messages, key in granted if "declare_queryable" in messages and "reply" in messages}
    asks = {key for flow, messages, key in granted if flow == "ingress" and "query" in messages}
    assert all(key.split("/")[4] == f"{role}-7" for key in asks), "and asks under its own name"
    assert bool({key for key in asks if "decide" in key}) == (role in ("actor", "client"))
    assert role in ("safety", "actor", "client") or not any("decide" in key for key in answers)
    assert not any("**" in key for _, _, key in granted)


@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("tcp/127.0.0.1:7447", True), ("tcp/127.8.0.1:7447", True), ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True), ("unixsock-stream//tmp/bus", True), ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False), ("tcp/10.0.0.1:7447", False), ("udp/127.0.0.1.evil.org:7447", False),
        ("tcp/:7447", False), ("quic/router:7447#iface=lo", False), ("nonsense", True),
    ],
)  # fmt: skip
def test_what_is_within_this_machine(endpoint: str, here: bool) -> None:
    assert local(endpoint) == here


def test_a_bus_that_others_reach_does_not_start_without_keys(keys: Path) -> None:
    port = free_endpoint().rsplit(":", 1)[1]
    open_to_all = f"tcp/0.0.0.0:{port}"
    with pytest.raises(BadKeys, match="--keys"):
        Bus(BusSettings(listen=(open_to_all,)), "launcher")
    with pytest.raises(ValueError, match="tls/"):
        Bus(BusSettings(listen=(open_to_all,), keys=keys), "launcher")
    with pytest.raises(ValueError, match="tls/"):
        Bus(BusSettings(connect=(f"tls/{HERE}:{port}",)), "actor-0")
    with Bus(BusSettings(listen=(f"tls/0.0.0.0:{port}",), keys=keys), "launcher"):
        pass


def test_without_keys_on_purpose_every_health_says_so() -> None:
    port = free_endpoint().rsplit(":", 1)[1]
    got: list[Sample] = []
    settings = BusSettings(listen=(f"tcp/0.0.0.0:{port}",), insecure=True)
    with Process(settings, "safety", stderr=False) as process:
        process.bus.subscribe(topics.HEALTH, got.append)
        for _ in range(3):
            before = len(got)
            process.announce()
            until(lambda: len(got) > before)  # noqa: B023
    assert len(got) >= 3
    for sample in got:
        assert "INSECURE" in sample.message().notes["security"]


def test_missing_keys_are_named(keys: Path, tmp_path: Path) -> None:
    settings = BusSettings(connect=("tls/127.0.0.1:1",), keys=keys)
    with pytest.raises(BadKeys, match=r"actor-77\.pem"):
        Bus(settings, "actor-77")
    with pytest.raises(BadKeys, match="no role"):
        Bus(settings, "bob")
    with pytest.raises(BadKeys, match=r"ca\.pem"):
        Bus(BusSettings(connect=("tls/127.0.0.1:1",), keys=tmp_path), "actor-0")


def test_private_keys_are_their_owners(keys: Path) -> None:
    for path in keys.glob("*.key"):
        assert path.stat().st_mode & 0o077 == 0, path
    assert keys.stat().st_mode & 0o077 == 0


@pytest.mark.fast
def test_a_name_that_no_key_can_hold_gets_no_certificate_and_is_no_name_to_accept(tmp_path: Path) -> None:
    """A router with `actor-*` in its list did not start any more, and `safety-/../x` put keys into another folder."""
    authority = Authority(tmp_path / "keys")
    authority.issue("router")
    for name in ("actor-*", "actor-$*", "actor-1 safety", "safety-/../../evil", "actor-é", "actor.0"):
        with pytest.raises(ValueError, match=r"cannot be the name of a process|no dot"):
            authority.issue(name)
    assert (tmp_path / "keys" / "names").read_text() == "router\n" and not list(tmp_path.glob("evil*"))
    (tmp_path / "keys" / "names").write_text("router\nactor-*\n")
    with pytest.raises(BadKeys, match=r"'actor-\*' cannot be the name"):
        names_in(tmp_path / "keys")


@pytest.mark.fast
@pytest.mark.parametrize("days", [0, -5, 10**6])
def test_certificates_of_an_impossible_validity_are_refused_before_there_is_a_folder(tmp_path: Path, days: int) -> None:
    with pytest.raises(ValueError, match=f"valid for 1 to .* days, not {days}"):
        Authority(tmp_path / "keys", days)
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize("host", ["10.0.0.1:7447", "tls/10.0.0.1", "", "a b", "höst"])
def test_a_host_that_no_process_could_reach_gets_no_certificate(tmp_path: Path, host: str) -> None:
    """Before, the certificate stated it, and clients refused the router."""
    with pytest.raises(ValueError, match="is no name or address of a host: give it without protocol and port"):
        Authority(tmp_path).issue("router", [host])
    assert not (tmp_path / "router.pem").exists()


@pytest.mark.parametrize("own", ["", "höst", "my_host"])
def test_the_names_of_this_machine_and_addresses_of_both_kinds_are_on_a_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: own)
    Authority(tmp_path).issue("router", ["[fe80::1]", "10.0.0.7", "router.example.org", "*.example.org"])
    certificate = x509.load_pem_x509_certificate((tmp_path / "router.pem").read_bytes())
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    hosts = names.get_values_for_type(x509.DNSName)
    assert hosts == ["localhost", *([own] if own == "my_host" else []), "router.example.org", "*.example.org"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)][2:] == ["fe80::1", "10.0.0.7"]
