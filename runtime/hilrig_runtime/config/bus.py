"""The `[bus]` section of `lab.toml`: links between the services, and their certificates."""

from pathlib import Path
from typing import Final, Literal

from pydantic import Field, model_validator

from hilrig_runtime.config.types import Flag, Name, Port, Section

IDENTITIES: Final = ("router", "sim", "edge", "recorder", "operator", "viewer")
"""Common names of the certificates of every secured bus; a lab may add more edges."""


class BusTlsConfig(Section):
    """Mutual TLS; the name in a certificate decides what its holder may do on the bus (`hilrig certs`)."""

    folder: Path = Path("certs/bus")
    """Folder with ca.pem, and <name>.pem and <name>.key of each service that runs on this host."""
    edges: dict[Name, tuple[Name, ...]] = Field(default_factory=dict)
    """Edges with a certificate of their own, and the rigs that each commands, as {east = ["rig1", "rig2"]}; default:
    one edge, `edge`, that commands every rig."""

    @model_validator(mode="after")
    def _edges_are_distinct(self) -> "BusTlsConfig":
        for name in self.edges:
            if name in IDENTITIES and name != "edge":
                raise ValueError(
                    f"edges.{name}: name already used by another certificate; choose a different edge name"
                )
        return self


class BusConfig(Section):
    """Links between the services."""

    topology: Literal["mesh", "router"] = "mesh"
    """mesh: services on one host, linked directly; router: every service is a client of `router`."""
    host: str = "127.0.0.1"
    """mesh: address on which the services listen for each other."""
    first_port: Port = 7447
    """mesh: port of the simulation; the edge and the recorder use the next two ports."""
    router: str = "tcp/127.0.0.1:7447"
    """router: endpoint of the zenoh router; with [bus.tls] it begins with tls/."""
    express: Flag = False
    """Send each control message at once instead of batching it with other messages; costs processor time."""
    tls: BusTlsConfig | None = None
    """Require certificates of this lab."""

    @property
    def router_host(self) -> str:
        """Host name or address in the endpoint of the router."""
        return self.router.partition("/")[2].partition("?")[0].rpartition(":")[0].strip("[]")

    @property
    def no_answer_hint(self) -> str:
        """What to check if no service answers; without a valid certificate a mesh looks empty."""
        valid = "" if self.tls is None else f", and with valid certificates in {self.tls.folder}"
        return f"is it running (hilrig up), with this lab.toml{valid}? See hilrig doctor"

    def may_serve(self, source: str, rig: str) -> bool:
        """Return whether a service, "<service>/<instance>", may publish for a rig according to its certificate."""
        service, _, instance = source.partition("/")
        edges = {} if self.tls is None else self.tls.edges
        return service != "edge" or not edges or rig in edges.get(instance, ())

    @model_validator(mode="after")
    def _router_and_tls_agree(self) -> "BusConfig":
        if self.topology == "router" and self.router.startswith("tls/") != (self.tls is not None):
            kind, why = ("tls/", "there is [bus.tls]") if self.tls is not None else ("tcp/", "there is no [bus.tls]")
            raise ValueError(f"router: must begin with {kind} because {why}, got {self.router!r}")
        return self
