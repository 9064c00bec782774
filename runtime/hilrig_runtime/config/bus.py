"""The `[bus]` section of `lab.toml`: how the services find each other, and who is let in."""

from pathlib import Path
from typing import Final, Literal

from pydantic import Field, model_validator

from hilrig_runtime.config.types import Flag, Name, Port, Section

IDENTITIES: Final = ("router", "sim", "edge", "recorder", "operator", "viewer")
"""Common names of the certificates that every secured bus has; a lab may add edges of its own."""


class BusTlsConfig(Section):
    """TLS with certificates on both sides, and what each certificate may do on the bus (`hilrig certs`)."""

    folder: Path = Path("certs/bus")
    """Where ca.pem is, and <name>.pem and <name>.key of the services that run on this host."""
    edges: dict[Name, tuple[Name, ...]] = Field(default_factory=dict)
    """Edges with a certificate of their own and the rigs that each commands, as {east = ["rig1", "rig2"]}; with none
    there is one, `edge`, that commands every rig."""

    @model_validator(mode="after")
    def _edges_are_distinct(self) -> "BusTlsConfig":
        for name in self.edges:
            if name in IDENTITIES and name != "edge":
                raise ValueError(f"edges.{name}: that is the name of another certificate: call the edge otherwise")
        return self


class BusConfig(Section):
    """How the services find each other."""

    topology: Literal["mesh", "router"] = "mesh"
    """mesh: services on one host, linked directly; router: everyone is a client of `router`."""
    host: str = "127.0.0.1"
    """mesh: address on which the services listen for each other."""
    first_port: Port = 7447
    """mesh: port of the simulation; the edge and the recorder take the next two."""
    router: str = "tcp/127.0.0.1:7447"
    """router: endpoint of the zenoh router; with [bus.tls] it begins with tls/."""
    express: Flag = False
    """Send each control message by itself, at the price of processor time, instead of with others that wait."""
    tls: BusTlsConfig | None = None
    """Let in only who has a certificate of the lab's."""

    @model_validator(mode="after")
    def _router_and_tls_agree(self) -> "BusConfig":
        if self.topology == "router" and self.router.startswith("tls/") != (self.tls is not None):
            kind, why = ("tls/", "there is [bus.tls]") if self.tls is not None else ("tcp/", "there is no [bus.tls]")
            raise ValueError(f"router: expected an endpoint that begins with {kind}, for {why}; found {self.router!r}")
        return self
