"""Access control of the bus: every topic has a rule, and the rules are as intended."""

from collections.abc import Iterator

import pytest

from hilrig_runtime.bus.acl import RULES, access_control
from hilrig_runtime.config.bus import BusTlsConfig
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import InputError
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import RigBatch
from hilrig_schemas.topics import COMMANDS, all_topics

TLS = BusTlsConfig(edges={"east": ("rig1", "rig2"), "west": ("rig3",)})


def granted(name: str, flow: str, message: str, tls: BusTlsConfig = TLS, lab: str = "lab") -> set[str]:
    def keys() -> Iterator[str]:
        section = access_control(tls, lab)
        [policy] = [policy for policy in section["policies"] if policy["subjects"] == [name]]
        for rule in section["rules"]:
            if rule["id"] in policy["rules"] and flow in rule["flows"] and message in rule["messages"]:
                yield from rule["key_exprs"]

    return set(keys())


def test_topics_and_rules_match() -> None:
    assert {topic.name for topic in all_topics()} == set(RULES)


def test_edge_commands_only_its_rigs() -> None:
    assert {key for key in granted("east", "ingress", "put") if "/commands/" in key} == {"hil/lab/commands/edge/east"}
    assert {key for key in granted("east", "ingress", "put") if key.endswith("/command")} == {
        "hil/lab/rig1/command",
        "hil/lab/rig2/command",
    }
    assert {key for key in granted("west", "ingress", "put") if key.endswith("/command")} == {"hil/lab/rig3/command"}


@pytest.mark.parametrize(
    ("flow", "message"),
    [("ingress", "put"), ("ingress", "declare_queryable"), ("ingress", "reply"), ("ingress", "liveliness_token")],
)
def test_edge_uses_keys_of_its_instance_only(flow: str, message: str) -> None:
    of_edges = [key for key in granted("east", flow, message) if "/edge/" in key.removeprefix("hil/lab/edge/")]
    assert of_edges
    assert all("/edge/east" in key for key in of_edges), of_edges


def test_single_edge_commands_all_rigs() -> None:
    assert "hil/lab/*/command" in granted("edge", "ingress", "put", BusTlsConfig())


@pytest.mark.parametrize("tool", ["operator", "viewer"])
def test_tools_may_not_publish(tool: str) -> None:
    assert granted(tool, "ingress", "put") == set()
    assert granted(tool, "ingress", "declare_queryable") == set()
    assert granted(tool, "ingress", "liveliness_token") == set()


def test_access_is_denied_by_default_and_outside_the_lab() -> None:
    section = access_control(TLS, "lab")
    assert (section["enabled"], section["default_permission"]) == (True, "deny")
    assert all(rule["permission"] == "allow" for rule in section["rules"])
    assert all(key.startswith("hil/lab/") for rule in section["rules"] for key in rule["key_exprs"])


def test_every_rule_has_one_identity() -> None:
    section = access_control(TLS, "lab")
    ids = [rule["id"] for rule in section["rules"]]
    assert len(ids) == len(set(ids))
    assert sorted(ids) == sorted(rule for policy in section["policies"] for rule in policy["rules"])


def test_commands_for_rigs_of_another_edge_are_ignored() -> None:
    def heard(permitted: dict[str, tuple[str, ...]], instance: str) -> set[str]:
        commands = LatestValueCache(ManualClock(), Counters(), permitted)
        batch = RigBatch(rigs=["rig1", "rig3"], messages=[b"one", b"three"])
        commands.on_message(COMMANDS.key("lab", "edge", instance), batch.SerializeToString())
        return {rig for rig in ("rig1", "rig3") if commands.get(rig) is not None}

    assert heard(dict(TLS.edges), "east") == {"rig1"}
    assert heard(dict(TLS.edges), "west") == {"rig3"}
    assert heard(dict(TLS.edges), "stranger") == set()
    assert heard({}, "1") == {"rig1", "rig3"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('topology = "router"\nrouter = "tcp/a:7447"\n[bus.tls]', "must begin with tls/"),
        ('topology = "router"\nrouter = "tls/a:7447"', r"must begin with tcp/.*no \[bus.tls\]"),
        ('[bus.tls]\nedges = {sim = ["rig1"]}', r"edges.sim: name already used by another certificate"),
        ('[bus.tls]\nedges = {east = ["rig9"]}', "bus.tls.edges.east: unknown rig 'rig9'"),
    ],
)
def test_inconsistent_bus_settings_are_reported(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_lab(f"[bus]\n{text}\n")
