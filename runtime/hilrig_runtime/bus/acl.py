"""Access control of the bus: one rule per topic, converted to zenoh's access control by certificate.

A certificate's common name is an identity, and each identity has a role. zenoh silently denies whatever no rule allows.
The rules describe the identity at the other end of a link, so that a router and every service of a mesh use the same
ones: ingress rules permit its publications, egress rules its receptions.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from hilrig_runtime.config.bus import BusTlsConfig
from hilrig_schemas import topics
from hilrig_schemas.topics import RIG_TOPICS, ROOT, SERVICE_TOPICS, SERVICES, Traffic, alive_key

TOOL_ROLES: Final = ("operator", "viewer")
"""Roles of tools: an operator may send requests to services, a viewer only receives."""


@dataclass(frozen=True, slots=True)
class Rule:
    """Roles that may publish on a topic or serve its queries, and roles that may subscribe to it or query it."""

    publishers: tuple[str, ...]
    """Publishers, or servers of a query topic."""
    subscribers: tuple[str, ...]
    """Subscribers, or clients of a query topic."""


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
    # A service checks for another instance with its rigs.
    topics.SERVICE_INFO.name: Rule(SERVICES, (*SERVICES, *TOOL_ROLES)),
    topics.STATES.name: Rule(("sim",), ("edge", *TOOL_ROLES)),
    topics.COMMANDS.name: Rule(("edge",), ("sim", *TOOL_ROLES)),
    topics.CONTROL.name: Rule(SERVICES, ("operator",)),
}
"""Rule of each topic, by the topic's name."""


@dataclass(frozen=True, slots=True)
class BusIdentity:
    """A common name, its role, and the rigs that it publishes for; `*`: all."""

    name: str
    role: str
    rigs: tuple[str, ...] = ("*",)
    instance: str = "*"
    """The instance whose keys it may use; `*`: all of its role, which share one certificate."""


def identities(tls: BusTlsConfig) -> list[BusIdentity]:
    """Return all accepted identities except the router."""
    edges = [BusIdentity(name, "edge", rigs, name) for name, rigs in tls.edges.items()] or [BusIdentity("edge", "edge")]
    return [BusIdentity("sim", "sim"), *edges, *(BusIdentity(role, role) for role in ("recorder", *TOOL_ROLES))]


def access_control(tls: BusTlsConfig, lab: str = "*") -> dict[str, Any]:
    """Return the `access_control` section of a zenoh configuration; `lab` `*`: all labs of this authority."""
    granted = {identity.name: list(_rules_of(identity, lab)) for identity in identities(tls)}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for rules in granted.values() for rule in rules],
        "subjects": [{"id": name, "cert_common_names": [name]} for name in granted],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": [name]} for name, rules in granted.items()],
    }


def _rules_of(identity: BusIdentity, lab: str) -> Iterable[dict[str, Any]]:
    published, served, subscribed, queried = _keys(identity, lab)
    recorded = [key for key in (*published, *subscribed) if f"/{topics.LOG.name}/" in key]
    # Caches, heartbeats and tokens of recording streams are under a verbatim chunk, which `**` does not match.
    caches = [f"{key}/@adv/**" for key in recorded]
    tokens = [alive_key(lab, identity.role, identity.instance)] if identity.role in SERVICES else []
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

    own_caches = [key for key in caches if any(key.startswith(f"{key_sent}/") for key_sent in published)]
    yield from rule("publishes", "ingress", ["put"], [*published, *own_caches])
    yield from rule("serves", "ingress", ["declare_queryable", "reply"], [*served, *own_caches])
    # A sample from a cache has the key of its stream.
    yield from rule("serves cache", "ingress", ["reply"], [key for key in published if key in recorded])
    yield from rule("receives queries", "egress", ["query"], [*_wildcard(served, lab), *own_caches])
    yield from rule("subscribes", "ingress", ["declare_subscriber"], [*subscribed, *caches])
    yield from rule("receives", "egress", ["put"], [*subscribed, *caches])
    yield from rule("queries", "ingress", ["query"], [*queried, *caches])
    yield from rule("receives replies", "egress", ["reply"], [*queried, *subscribed, *caches])
    yield from rule("declares tokens", "ingress", ["liveliness_token"], [*tokens, *own_caches])
    watched = [alive_key(lab, "*", "*"), *caches]
    yield from rule("subscribes to tokens", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], watched)
    yield from rule("receives tokens", "egress", ["liveliness_token"], watched)
    # Declarations are not secret in a lab, and without them publishers would not send.
    yield from rule("receives declarations", "egress", ["declare_subscriber", "declare_queryable"], everything)


def _keys(identity: BusIdentity, lab: str) -> tuple[list[str], list[str], list[str], list[str]]:
    """Return the keys that an identity publishes, serves, subscribes to and queries."""
    published: list[str] = []
    served: list[str] = []
    subscribed: list[str] = []
    queried: list[str] = []
    for rig_topic in RIG_TOPICS:
        rule, query = RULES[rig_topic.name], rig_topic.traffic is Traffic.QUERY
        if identity.role in rule.publishers:
            (served if query else published).extend(rig_topic.key(lab, rig) for rig in identity.rigs)
            if rig_topic is topics.EVENT:
                # Events without a rig are published under the service's name.
                published.append(rig_topic.key(lab, identity.role))
        if identity.role in rule.subscribers:
            (queried if query else subscribed).append(rig_topic.key(lab, "*"))
    for topic in SERVICE_TOPICS:
        rule, query = RULES[topic.name], topic.traffic is Traffic.QUERY
        if identity.role in rule.publishers:
            (served if query else published).append(topic.key(lab, identity.role, identity.instance))
        if identity.role in rule.subscribers:
            (queried if query else subscribed).append(topic.key(lab, "*", "*"))
    return published, served, subscribed, queried


def _wildcard(keys: Iterable[str], lab: str) -> list[str]:
    """Return the keys with wildcards, as in a query to all rigs."""
    wildcards = []
    for key in keys:
        parts = key.split("/")
        reserved = parts[2] in topics.RESERVED_RIG_NAMES
        wildcards.append("/".join([ROOT, lab, parts[2], "*", "*"] if reserved else [ROOT, lab, "*", parts[3]]))
    return sorted(set(wildcards))
