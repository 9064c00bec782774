"""Who may do what on the bus: one rule a topic, turned into zenoh's own access control by certificate.

A certificate's common name is an identity, and each identity has a role. What no rule allows is denied, silently, as
zenoh does. The rules are seen from the identity at the other end of a link, so that a router and every service of a
mesh take the same ones: what comes in from it is what it may send, what goes out to it is what it may read.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from hilrig_runtime.config.bus import BusTlsConfig
from hilrig_schemas import topics
from hilrig_schemas.topics import RIG_TOPICS, ROOT, SERVICE_TOPICS, SERVICES, Traffic, alive_key

TOOL_ROLES: Final = ("operator", "viewer")
"""An operator asks services to do things; a viewer only looks."""


@dataclass(frozen=True, slots=True)
class Rule:
    """Roles that send on a topic, or answer on it where it is asked for, and roles that read or ask."""

    senders: tuple[str, ...]
    readers: tuple[str, ...]


RULES: Final[dict[str, Rule]] = {
    topics.STATE.name: Rule(("sim",), ("edge", *TOOL_ROLES)),
    topics.COMMAND.name: Rule(("edge",), ("sim", *TOOL_ROLES)),
    topics.EVENT.name: Rule(SERVICES, ("recorder", *TOOL_ROLES)),
    topics.TRAFFIC.name: Rule(("edge",), TOOL_ROLES),
    topics.CONFIG.name: Rule(("sim",), ("edge", "recorder", *TOOL_ROLES)),
    topics.LEASE.name: Rule(("edge",), ("operator",)),
    topics.IMPAIRMENT.name: Rule(("edge",), ("operator",)),
    topics.LOG.name: Rule(SERVICES, ("recorder",)),
    topics.HEALTH.name: Rule(SERVICES, (*SERVICES, *TOOL_ROLES)),
    # A service asks whether another one does its work already.
    topics.SERVICE_INFO.name: Rule(SERVICES, (*SERVICES, *TOOL_ROLES)),
    topics.STATES.name: Rule(("sim",), ("edge", *TOOL_ROLES)),
    topics.COMMANDS.name: Rule(("edge",), ("sim", *TOOL_ROLES)),
    # A recorder asks whether another one records the lab already.
    topics.CONTROL.name: Rule(SERVICES, ("recorder", "operator")),
}
"""Rule of each topic, by its name."""


@dataclass(frozen=True, slots=True)
class BusIdentity:
    """A common name, its role, and the rigs that it sends for; `*`: all."""

    name: str
    role: str
    rigs: tuple[str, ...] = ("*",)


def identities(tls: BusTlsConfig) -> list[BusIdentity]:
    """Everyone who is let in, the router apart."""
    edges = [BusIdentity(name, "edge", rigs) for name, rigs in tls.edges.items()] or [BusIdentity("edge", "edge")]
    return [
        BusIdentity("sim", "sim"),
        *edges,
        BusIdentity("recorder", "recorder"),
        *(BusIdentity(t, t) for t in TOOL_ROLES),
    ]


def access_control(tls: BusTlsConfig, lab: str = "*") -> dict[str, Any]:
    """The `access_control` section of a zenoh configuration; `lab` `*`: any that this authority serves."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity in identities(tls):
        granted = list(_rules_of(identity, lab))
        rules += granted
        subjects.append({"id": identity.name, "cert_common_names": [identity.name]})
        policies.append({"rules": [rule["id"] for rule in granted], "subjects": [identity.name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules_of(identity: BusIdentity, lab: str) -> Iterable[dict[str, Any]]:
    sends, serves, reads, asks = _keys(identity, lab)
    recorded = [key for key in (*sends, *reads) if f"/{topics.LOG.name}/" in key]
    # The caches of recording streams, their heartbeats and tokens stand under a verbatim part that `**` leaves out.
    caches = [f"{key}/@adv/**" for key in recorded]
    shows = [alive_key(lab, identity.role, "*")] if identity.role in SERVICES else []
    everything = [f"{ROOT}/{lab}/**", f"{ROOT}/{lab}/**/@adv/**"]

    def rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> Iterable[dict[str, Any]]:
        if keys:
            yield {
                "id": f"{identity.name} {name}",
                "permission": "allow",
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": list(keys),
            }

    own = [key for key in caches if any(key.startswith(f"{sent}/") for sent in sends)]
    yield from rule("sends", "ingress", ["put"], [*sends, *own])
    yield from rule("answers", "ingress", ["declare_queryable", "reply"], [*serves, *own])
    # What is repeated from a cache has the key of the stream itself.
    yield from rule("repeats", "ingress", ["reply"], [key for key in sends if key in recorded])
    yield from rule("is asked", "egress", ["query"], [*_widened(serves, lab), *own])
    yield from rule("subscribes", "ingress", ["declare_subscriber"], [*reads, *caches])
    yield from rule("receives", "egress", ["put"], [*reads, *caches])
    yield from rule("asks", "ingress", ["query"], [*asks, *caches])
    yield from rule("is answered", "egress", ["reply"], [*asks, *reads, *caches])
    yield from rule("lives", "ingress", ["liveliness_token"], [*shows, *own])
    watched = [alive_key(lab, "*", "*"), *caches]
    yield from rule("watches", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], watched)
    yield from rule("sees", "egress", ["liveliness_token"], watched)
    # Who listens to what is no secret in a lab, and without it nobody would send.
    yield from rule("hears of", "egress", ["declare_subscriber", "declare_queryable"], everything)


def _keys(identity: BusIdentity, lab: str) -> tuple[list[str], list[str], list[str], list[str]]:
    """Keys on which an identity sends, answers, reads and asks."""
    sends: list[str] = []
    serves: list[str] = []
    reads: list[str] = []
    asks: list[str] = []
    for rig_topic in RIG_TOPICS:
        rule, query = RULES[rig_topic.name], rig_topic.traffic is Traffic.QUERY
        if identity.role in rule.senders:
            (serves if query else sends).extend(rig_topic.key(lab, rig) for rig in identity.rigs)
            if rig_topic is topics.EVENT:
                # Events of a service as a whole stand under its own name.
                sends.append(rig_topic.key(lab, identity.role))
        if identity.role in rule.readers:
            (asks if query else reads).append(rig_topic.key(lab, "*"))
    for topic in SERVICE_TOPICS:
        rule, query = RULES[topic.name], topic.traffic is Traffic.QUERY
        if identity.role in rule.senders:
            # Whose commands a batch holds is told by its key: an edge with rigs of its own has a key of its own.
            own_key = topic is topics.COMMANDS and identity.rigs != ("*",)
            (serves if query else sends).append(topic.key(lab, identity.role, identity.name if own_key else "*"))
        if identity.role in rule.readers:
            (asks if query else reads).append(topic.key(lab, "*", "*"))
    return sends, serves, reads, asks


def _widened(keys: Iterable[str], lab: str) -> list[str]:
    """The keys as questions name them: a question to all rigs reaches each of them."""
    wide = []
    for key in keys:
        parts = key.split("/")
        reserved = parts[2] in topics.RESERVED_RIG_NAMES
        wide.append("/".join([ROOT, lab, parts[2], "*", "*"] if reserved else [ROOT, lab, "*", parts[3]]))
    return sorted(set(wide))
