"""The secured bus over real sockets: what each certificate may send, read, ask and answer, and nothing else.

One process is attacked: the router, or a service of the mesh. It subscribes to everything, publishes everything and
answers everything. Others come to it with each certificate of the lab in turn, and try all there is; they have no
rules of their own to hold them back. The attacked process's rules for one direction are opened meanwhile, so that those
for the other are seen to hold alone. The tables here say what is to get through; they are not made from the rules.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zenoh

from hilrig_runtime.bus.zenoh_config import router_config, zenoh_config
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.security.x509 import load
from support.bus_certificates import folder_of_one, make_bus_folder
from support.labs import free_ports
from support.waiting import eventually

pytestmark = pytest.mark.rig

EDGES = {"east": ("rig1",), "west": ("rig2",)}
NAMES = ["router", "sim", *EDGES, "recorder", "operator", "viewer", "student"]
CASES = [("router", name) for name in NAMES[1:]] + [
    ("mesh", name) for name in ("sim", "east", "recorder", "operator", "student")
]
SERVICE = {"sim": "sim", "east": "edge", "west": "edge", "recorder": "recorder"}

SENT = [
    *(f"{rig}/{topic}" for rig in ("rig1", "rig2") for topic in ("state", "command", "event", "traffic")),
    *(f"{service}/event" for service in ("sim", "edge", "recorder")),
    *(f"{topic}/{service}/1" for topic in ("log", "health") for service in ("sim", "edge", "recorder")),
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
    "east": {*_of_edge("east", "rig1"), "edge/event", "log/edge/1", "health/edge/1"},
    "west": {*_of_edge("west", "rig2"), "edge/event", "log/edge/1", "health/edge/1"},
    "recorder": {"log/recorder/1", "health/recorder/1", *_EVENTS},
    "operator": set(),
    "viewer": set(),
    "student": set(),
}
_HEALTHS = {key for key in SENT if key.startswith("health/")}
_STATES = {"rig1/state", "rig2/state", "states/sim/1"}
MAY_READ: dict[str, set[str]] = {
    "sim": {"rig1/command", "rig2/command", "commands/edge/east", "commands/edge/west", *_HEALTHS},
    "east": _STATES | _HEALTHS,
    "west": _STATES | _HEALTHS,
    "recorder": _EVENTS | _LOGS | _HEALTHS,
    "operator": set(SENT) - _LOGS,
    "viewer": set(SENT) - _LOGS,
    "student": set(),
}
_CONFIGS = {"rig1/config", "rig2/config"}
_OF_EDGES = {f"{rig}/{topic}" for rig in ("rig1", "rig2") for topic in ("lease", "impairment")}
_SERVICE_INFOS = {"service_info/sim/1", "service_info/edge/1", "service_info/recorder/1"}
_CONTROLS = {"control/sim/1", "control/edge/1", "control/recorder/1"}
ASKED = sorted(_CONFIGS | _OF_EDGES | _SERVICE_INFOS | _CONTROLS)
MAY_ASK: dict[str, set[str]] = {
    "sim": _SERVICE_INFOS,
    "east": _CONFIGS | _SERVICE_INFOS,
    "west": _CONFIGS | _SERVICE_INFOS,
    "recorder": _CONFIGS | _SERVICE_INFOS | _CONTROLS,
    "operator": set(ASKED),
    "viewer": _CONFIGS | _SERVICE_INFOS,
    "student": set(),
}
MAY_ANSWER: dict[str, set[str]] = {
    "sim": {*_CONFIGS, "service_info/sim/1", "control/sim/1"},
    "east": {"rig1/lease", "rig1/impairment", "service_info/edge/1", "control/edge/1"},
    "west": {"rig2/lease", "rig2/impairment", "service_info/edge/1", "control/edge/1"},
    "recorder": {"service_info/recorder/1", "control/recorder/1"},
    "operator": set(),
    "viewer": set(),
    "student": set(),
}
# A question to all goes out to everyone of a kind; what one answers is held by the other direction's rules.
MAY_BE_ASKED = MAY_ANSWER | {
    "sim": _CONFIGS | _SERVICE_INFOS | _CONTROLS,
    **dict.fromkeys(EDGES, _OF_EDGES | _SERVICE_INFOS | _CONTROLS),
    "recorder": _SERVICE_INFOS | _CONTROLS,
}
FLOWS = {"ingress", "egress"}
LIVING = ["alive/sim/1", "alive/edge/1", "alive/recorder/1"]
MAY_LIVE: dict[str, set[str]] = {name: {f"alive/{SERVICE[name]}/1"} if name in SERVICE else set() for name in MAY_SEND}


def key(name: str) -> str:
    return f"hil/lab/{name}"


@dataclass
class Heard:
    """What a session received: who sent it, on which key, how often."""

    counts: dict[tuple[str, str], int] = field(default_factory=dict)

    def listen(self, session: zenoh.Session, key_expr: str) -> Any:
        return session.declare_subscriber(key_expr, self._on_sample)

    def of(self, sender: str) -> set[str]:
        return {name for who, name in list(self.counts) if who == sender}

    def _on_sample(self, sample: zenoh.Sample) -> None:
        heard = sample.payload.to_bytes().decode(), str(sample.key_expr).removeprefix("hil/lab/")
        self.counts[heard] = self.counts.get(heard, 0) + 1


@dataclass
class Meeting:
    """The attacked process, somebody who came with a certificate, and an honest witness of the lab."""

    attacked: zenoh.Session
    guest: zenoh.Session
    witness: zenoh.Session
    witness_key: str
    name: str
    flow: str


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bus") / "all"
    authority = make_bus_folder(folder, NAMES)
    for name in NAMES[1:]:
        identity = load((folder / f"{name}.pem").read_bytes(), (folder / f"{name}.key").read_bytes())
        # A student's certificate is signed by the lab, and its file has a name that is let in; what counts is within.
        folder_of_one(folder.parent / name, authority, "viewer" if name == "student" else name, identity)
    return folder


def _opened(section: dict[str, Any], flows: set[str]) -> dict[str, Any]:
    """The rules, with everything allowed to everyone in some directions."""
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
        "subjects": [*section["subjects"], {"id": "anyone"}],
        "policies": [*section["policies"], {"rules": ["open"], "subjects": ["anyone"]}],
    }


@contextmanager
def meeting(folder: Path, topology: str, name: str, flow: str) -> Iterator[Meeting]:
    """Everyone joined; of the attacked process's rules those for `flow` hold, the others are opened; "": all are."""
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

    def join(who: str) -> zenoh.Session:
        config = zenoh_config(bus(folder.parent / who), SERVICE.get(who, "tool"))
        config.insert_json5("access_control", '{"enabled": false}')
        return zenoh.open(config)

    witness = "east" if name == "recorder" else "recorder"
    if topology == "router":
        config = router_config(bus(folder), "lab", f"tls/127.0.0.1:{port}")
    else:
        config = zenoh_config(bus(folder), "edge" if name == "sim" else "sim")
    rules = json.loads(config.get_json("access_control"))
    config.insert_json5("access_control", json.dumps(_opened(rules, FLOWS - {flow})))
    with zenoh.open(config) as attacked, join(name) as guest, join(witness) as second:
        yield Meeting(attacked, guest, second, f"{SERVICE[witness]}/event", name, flow)


@pytest.mark.parametrize("flow", sorted(FLOWS))
@pytest.mark.parametrize(("topology", "name"), CASES)
def test_a_certificate_gets_through_with_what_is_its_own_and_nothing_else(
    folder: Path, topology: str, name: str, flow: str
) -> None:
    with meeting(folder, topology, name, flow) as met:
        if flow == "ingress":
            assert sent_to_the_attacked(met) == MAY_SEND[name]
            assert shown_alive(met) == MAY_LIVE[name]
        assert read_from_the_attacked(met) == MAY_READ[name]
        assert answered_by_the_attacked(met) == MAY_ASK[name]
        assert answered_to_the_attacked(met) == (MAY_ANSWER if flow == "ingress" else MAY_BE_ASKED)[name]


@pytest.mark.parametrize("topology", ["router", "mesh"])
def test_with_open_rules_all_that_is_tried_gets_through(folder: Path, topology: str) -> None:
    with meeting(folder, topology, "student", "") as met:
        for tried, everything in (
            (sent_to_the_attacked, SENT),
            (shown_alive, LIVING),
            (read_from_the_attacked, SENT),
            (answered_by_the_attacked, ASKED),
            (answered_to_the_attacked, ASKED),
        ):
            eventually(lambda tried=tried, everything=everything: tried(met) >= set(everything) - {"alive/recorder/1"})


def sent_to_the_attacked(met: Meeting) -> set[str]:
    heard = Heard()
    with heard.listen(met.attacked, key("**")):

        def try_all() -> bool:
            for name in SENT:
                met.guest.put(key(name), met.name)
            met.witness.put(key(met.witness_key), "witness")
            witnessed = heard.counts.get(("witness", met.witness_key), 0)
            return witnessed >= 5 and MAY_SEND[met.name] <= heard.of(met.name)

        eventually(try_all, every_s=0.02)
    return heard.of(met.name)


def read_from_the_attacked(met: Meeting) -> set[str]:
    guest_heard, witness_heard = Heard(), Heard()
    # As a whole, and one by one: the rules may let in the one and not the other.
    listening = [guest_heard.listen(met.guest, key_expr) for key_expr in ("hil/**", *map(key, SENT))]
    watching = witness_heard.listen(met.witness, key("*/state" if met.witness_key == "edge/event" else "*/event"))

    def say_all() -> bool:
        for name in SENT:
            met.attacked.put(key(name), "attacked")
        return sum(witness_heard.counts.values()) >= 15 and MAY_READ[met.name] <= guest_heard.of("attacked")

    eventually(say_all, every_s=0.02)
    for declared in (*listening, watching):
        declared.undeclare()
    return guest_heard.of("attacked")


def answered_by_the_attacked(met: Meeting) -> set[str]:
    return _answered(met.attacked, met.guest, MAY_ASK[met.name])


def answered_to_the_attacked(met: Meeting) -> set[str]:
    return _answered(met.guest, met.attacked, MAY_ANSWER[met.name])


def _answered(server: zenoh.Session, asker: zenoh.Session, expected: set[str]) -> set[str]:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"answer")

    served = [server.declare_queryable(key(name), answer) for name in ASKED]
    answered: set[str] = set()
    rounds = 0

    def ask_all() -> bool:
        nonlocal rounds
        rounds += 1
        for name in ASKED:
            replies = asker.get(key(name), timeout=0.3, target=zenoh.QueryTarget.ALL)
            if any(reply.ok is not None for reply in replies):
                answered.add(name)
        return rounds >= 2 and expected <= answered

    eventually(ask_all)
    for declared in served:
        declared.undeclare()
    return answered


def shown_alive(met: Meeting) -> set[str]:
    tokens = [met.guest.liveliness().declare_token(key(name)) for name in LIVING]
    witnessed = met.witness.liveliness().declare_token(key(f"alive/{met.witness_key.partition('/')[0]}/1"))
    shown: set[str] = set()

    def look() -> bool:
        replies = met.attacked.liveliness().get(key("alive/**"), timeout=0.3)
        shown.update(str(reply.ok.key_expr).removeprefix("hil/lab/") for reply in replies if reply.ok is not None)
        return MAY_LIVE[met.name] | {f"alive/{met.witness_key.partition('/')[0]}/1"} <= shown

    eventually(look)
    for token in (*tokens, witnessed):
        token.undeclare()
    return shown - {f"alive/{met.witness_key.partition('/')[0]}/1"}
