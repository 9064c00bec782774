"""Access control of the secured bus over real sockets: permitted keys of each certificate for each operation.

The process under test is the router or a service of the mesh; it subscribes to, publishes and answers every key. A
client connects with each certificate of the lab and tries every key; it has no access rules of its own. The rules of
the process under test are replaced by open rules in one direction, so that the other direction is tested alone. The
tables below list the permitted keys; they are independent of the rules in the product.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from hilrig_runtime.bus.zenoh_config import router_config, zenoh_config
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.security.x509 import load
from support.bus_certificates import make_bus_folder, make_client_folder
from support.labs import free_ports
from support.waiting import eventually

pytestmark = pytest.mark.rig

EDGES: dict[str, tuple[str, ...]] = {"east": ("rig1",), "west": ("rig2",)}
NAMES = ["router", "sim", *EDGES, "recorder", "operator", "viewer", "student"]
CASES = [("router", name) for name in NAMES[1:]] + [
    ("mesh", name) for name in ("sim", "east", "recorder", "operator", "student")
]
SERVICE = {"sim": "sim", "east": "edge", "west": "edge", "recorder": "recorder"}

SENT = [
    *(f"{rig}/{topic}" for rig in ("rig1", "rig2") for topic in ("state", "command", "event", "traffic")),
    *(f"{service}/event" for service in ("sim", "edge", "recorder")),
    *(
        f"{topic}/{source}"
        for topic in ("log", "health")
        for source in ("sim/1", "edge/east", "edge/west", "recorder/1")
    ),
    "states/sim/1",
    "commands/edge/east",
    "commands/edge/west",
]
_EVENTS = {key for key in SENT if key.endswith("/event")}
_LOGS = {key for key in SENT if key.startswith("log/")}


def _of_edge(name: str, rig: str) -> set[str]:
    return {f"{rig}/command", f"{rig}/event", f"{rig}/traffic", f"commands/edge/{name}"}


MAY_SEND: dict[str, set[str]] = {
    "sim": {"rig1/state", "rig2/state", "states/sim/1", "log/sim/1", "health/sim/1", *_EVENTS},
    "east": {*_of_edge("east", "rig1"), "edge/event", "log/edge/east", "health/edge/east"},
    "west": {*_of_edge("west", "rig2"), "edge/event", "log/edge/west", "health/edge/west"},
    "recorder": {"log/recorder/1", "health/recorder/1", *_EVENTS},
    "operator": set(),
    "viewer": set(),
    "student": set(),
}
_HEALTH = {key for key in SENT if key.startswith("health/")}
_STATES = {"rig1/state", "rig2/state", "states/sim/1"}
MAY_READ: dict[str, set[str]] = {
    "sim": {"rig1/command", "rig2/command", "commands/edge/east", "commands/edge/west", *_HEALTH},
    "east": _STATES | _HEALTH,
    "west": _STATES | _HEALTH,
    "recorder": _EVENTS | _LOGS | _HEALTH,
    "operator": set(SENT) - _LOGS,
    "viewer": set(SENT) - _LOGS,
    "student": set(),
}
_CONFIGS = {"rig1/config", "rig2/config"}
_EDGE_QUERIES = {f"{rig}/{topic}" for rig in ("rig1", "rig2") for topic in ("lease", "impairment")}
_SOURCES = ("sim/1", "edge/east", "edge/west", "recorder/1")
_SERVICE_INFOS = {f"service_info/{source}" for source in _SOURCES}
_CONTROLS = {f"control/{source}" for source in _SOURCES}
QUERIED = sorted(_CONFIGS | _EDGE_QUERIES | _SERVICE_INFOS | _CONTROLS)
MAY_QUERY: dict[str, set[str]] = {
    "sim": _SERVICE_INFOS,
    "east": _CONFIGS | _SERVICE_INFOS,
    "west": _CONFIGS | _SERVICE_INFOS,
    "recorder": _CONFIGS | _SERVICE_INFOS,
    "operator": set(QUERIED),
    "viewer": _CONFIGS | _SERVICE_INFOS,
    "student": set(),
}
MAY_ANSWER: dict[str, set[str]] = {
    "sim": {*_CONFIGS, "service_info/sim/1", "control/sim/1"},
    "east": {"rig1/lease", "rig1/impairment", "service_info/edge/east", "control/edge/east"},
    "west": {"rig2/lease", "rig2/impairment", "service_info/edge/west", "control/edge/west"},
    "recorder": {"service_info/recorder/1", "control/recorder/1"},
    "operator": set(),
    "viewer": set(),
    "student": set(),
}
# A query is sent to all services of a kind; the rules of the other direction restrict the replies.
MAY_BE_QUERIED = MAY_ANSWER | {
    "sim": _CONFIGS | _SERVICE_INFOS | _CONTROLS,
    **dict.fromkeys(EDGES, _EDGE_QUERIES | _SERVICE_INFOS | _CONTROLS),
    "recorder": _SERVICE_INFOS | _CONTROLS,
}
FLOWS = {"ingress", "egress"}
TOKENS = [f"alive/{source}" for source in _SOURCES]
MAY_DECLARE: dict[str, set[str]] = {
    name: {f"alive/{SERVICE[name]}/{name if name in EDGES else '1'}"} if name in SERVICE else set() for name in MAY_SEND
}


def key(name: str) -> str:
    return f"hil/lab/{name}"


@dataclass
class MessageCounter:
    """Counts the messages received by a session, by sender and key."""

    counts: dict[tuple[str, str], int] = field(default_factory=dict)

    def listen(self, session: zenoh.Session, key_expr: str) -> Any:
        return session.declare_subscriber(key_expr, self._on_sample)

    def of(self, sender: str) -> set[str]:
        return {name for who, name in list(self.counts) if who == sender}

    def _on_sample(self, sample: zenoh.Sample) -> None:
        message = sample.payload.to_bytes().decode(), str(sample.key_expr).removeprefix("hil/lab/")
        self.counts[message] = self.counts.get(message, 0) + 1


@dataclass
class Sessions:
    """Sessions of a test: the process under test, a client with a certificate, and a reference service of the lab."""

    tested: zenoh.Session
    client: zenoh.Session
    reference: zenoh.Session
    reference_key: str
    name: str
    flow: str


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bus") / "all"
    authority = make_bus_folder(folder, NAMES)
    for name in NAMES[1:]:
        identity = load((folder / f"{name}.pem").read_bytes(), (folder / f"{name}.key").read_bytes())
        # The student's certificate is signed by the lab and its file has a permitted name; the common name is decisive.
        make_client_folder(folder.parent / name, authority, "viewer" if name == "student" else name, identity)
    return folder


def _opened(section: dict[str, Any], flows: set[str]) -> dict[str, Any]:
    """Return the rules with everything permitted for every certificate in some directions."""
    messages = ["put", "delete", "declare_subscriber", "query", "declare_queryable", "reply"]
    messages += ["liveliness_token", "declare_liveliness_subscriber", "liveliness_query"]
    rule = {
        "id": "open",
        "permission": "allow",
        "flows": sorted(flows),
        "messages": messages,
        "key_exprs": ["**", "**/@adv/**"],
    }
    return section | {
        "rules": [*section["rules"], rule],
        "subjects": [*section["subjects"], {"id": "any"}],
        "policies": [*section["policies"], {"rules": ["open"], "subjects": ["any"]}],
    }


@contextmanager
def connected_sessions(folder: Path, topology: str, name: str, flow: str) -> Iterator[Sessions]:
    """Connect all sessions; the rules of the process under test apply to `flow` only ("": to no direction)."""
    port = free_ports(3)

    def bus(of: Path) -> BusConfig:
        return BusConfig.model_validate(
            {
                "topology": topology,
                "router": f"tls/127.0.0.1:{port}",
                "first_port": port,
                "tls": BusTlsConfig(folder=of, edges=EDGES),
            }
        )

    def connect(who: str) -> zenoh.Session:
        config = zenoh_config(bus(folder.parent / who), SERVICE.get(who, "tool"))
        config.insert_json5("access_control", '{"enabled": false}')
        return zenoh.open(config)

    reference = "east" if name == "recorder" else "recorder"
    if topology == "router":
        config = router_config(bus(folder), "lab", f"tls/127.0.0.1:{port}")
    else:
        config = zenoh_config(bus(folder), "edge" if name == "sim" else "sim")
    rules = json.loads(config.get_json("access_control"))
    config.insert_json5("access_control", json.dumps(_opened(rules, FLOWS - {flow})))
    with zenoh.open(config) as tested, connect(name) as client, connect(reference) as second:
        yield Sessions(tested, client, second, f"{SERVICE[reference]}/event", name, flow)


@pytest.mark.parametrize("flow", sorted(FLOWS))
@pytest.mark.parametrize(("topology", "name"), CASES)
def test_certificate_permits_only_its_own_keys(folder: Path, topology: str, name: str, flow: str) -> None:
    with connected_sessions(folder, topology, name, flow) as sessions:
        if flow == "ingress":
            assert keys_sent(sessions) == MAY_SEND[name]
            assert tokens_seen(sessions) == MAY_DECLARE[name]
        assert keys_read(sessions) == MAY_READ[name]
        assert keys_queried(sessions) == MAY_QUERY[name]
        assert keys_answered(sessions) == (MAY_ANSWER if flow == "ingress" else MAY_BE_QUERIED)[name]


@pytest.mark.parametrize("topology", ["router", "mesh"])
def test_open_rules_permit_every_key(folder: Path, topology: str) -> None:
    with connected_sessions(folder, topology, "student", "") as sessions:

        def is_permitted(tried: Callable[[Sessions], set[str]], wanted: set[str]) -> bool:
            return tried(sessions) >= wanted

        for tried, everything in (
            (keys_sent, SENT),
            (tokens_seen, TOKENS),
            (keys_read, SENT),
            (keys_queried, QUERIED),
            (keys_answered, QUERIED),
        ):
            wanted = set(everything) - {"alive/recorder/1"}
            eventually(partial(is_permitted, tried, wanted))


def keys_sent(sessions: Sessions) -> set[str]:
    counter = MessageCounter()
    with counter.listen(sessions.tested, key("**")):

        def try_all() -> bool:
            for name in SENT:
                sessions.client.put(key(name), sessions.name)
            sessions.reference.put(key(sessions.reference_key), "reference")
            reference_count = counter.counts.get(("reference", sessions.reference_key), 0)
            return reference_count >= 5 and MAY_SEND[sessions.name] <= counter.of(sessions.name)

        eventually(try_all, every_s=0.02)
    return counter.of(sessions.name)


def keys_read(sessions: Sessions) -> set[str]:
    client_counter, reference_counter = MessageCounter(), MessageCounter()
    # Subscribe to a wildcard and to each key: the rules may permit one and not the other.
    subscribers = [client_counter.listen(sessions.client, key_expr) for key_expr in ("hil/**", *map(key, SENT))]
    reference_subscriber = reference_counter.listen(
        sessions.reference, key("*/state" if sessions.reference_key == "edge/event" else "*/event")
    )

    def publish_all() -> bool:
        for name in SENT:
            sessions.tested.put(key(name), "tested")
        return sum(reference_counter.counts.values()) >= 15 and MAY_READ[sessions.name] <= client_counter.of("tested")

    eventually(publish_all, every_s=0.02)
    for declared in (*subscribers, reference_subscriber):
        declared.undeclare()
    return client_counter.of("tested")


def keys_queried(sessions: Sessions) -> set[str]:
    return _answered(sessions.tested, sessions.client, MAY_QUERY[sessions.name])


def keys_answered(sessions: Sessions) -> set[str]:
    return _answered(sessions.client, sessions.tested, MAY_ANSWER[sessions.name])


def _answered(server: zenoh.Session, querier: zenoh.Session, expected: set[str]) -> set[str]:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"answer")

    served = [server.declare_queryable(key(name), answer) for name in QUERIED]
    answered: set[str] = set()
    rounds = 0

    def query_all() -> bool:
        nonlocal rounds
        rounds += 1
        for name in QUERIED:
            replies = querier.get(key(name), timeout=0.3, target=zenoh.QueryTarget.ALL)
            if any(reply.ok is not None for reply in replies):
                answered.add(name)
        return rounds >= 2 and expected <= answered

    eventually(query_all)
    for declared in served:
        declared.undeclare()
    return answered


def tokens_seen(sessions: Sessions) -> set[str]:
    tokens = [sessions.client.liveliness().declare_token(key(name)) for name in TOKENS]
    reference = "alive/edge/east" if sessions.reference_key == "edge/event" else "alive/recorder/1"
    reference_token = sessions.reference.liveliness().declare_token(key(reference))
    shown: set[str] = set()

    def query_tokens() -> bool:
        replies = sessions.tested.liveliness().get(key("alive/**"), timeout=0.3)
        shown.update(str(reply.ok.key_expr).removeprefix("hil/lab/") for reply in replies if reply.ok is not None)
        return MAY_DECLARE[sessions.name] | {reference} <= shown

    eventually(query_tokens)
    for token in (*tokens, reference_token):
        token.undeclare()
    return shown - {reference}
