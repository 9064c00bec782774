"""Tests of Modbus/TCP Security: valid, invalid, expired and missing certificates, and roles."""

import gc
import json
import shutil
import socket
import ssl
import stat
import struct
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random, SystemRandom

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization

from generate_conformance import SECURITY_RULES
from hilrig_modbus_edge.server.tls import TlsPolicy
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.errors import InputError
from hilrig_runtime.security.x509 import (
    ROLE_OID,
    Credential,
    issue_client,
    issue_server,
    make_authority,
    names_in,
    role_of,
)
from hilrig_schemas import Event
from support.edge_rig import EdgeRig, running_edge
from support.labs import free_ports, hilrig
from support.waiting import eventually

pytestmark = pytest.mark.rig

NOW = datetime.now(UTC)
READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 4)
WRITE = struct.pack(">HHHBBHH", 2, 0, 6, 1, 6, 0, 1000)


@dataclass
class Lab:
    """Certificates of a lab, in a folder."""

    folder: Path
    authority: Credential

    def write(self, name: str, identity: Credential) -> None:
        (self.folder / f"{name}.pem").write_bytes(identity.certificate_pem)
        (self.folder / f"{name}.key").write_bytes(identity.key_pem)

    def client(self, name: str) -> ssl.SSLContext:
        context = ssl.create_default_context(cafile=self.folder / "ca.pem")
        if name:
            context.load_cert_chain(self.folder / f"{name}.pem", self.folder / f"{name}.key")
        return context

    def tls(self, port: int, **more: str) -> dict[str, object]:
        files = {"certificate": "edge.pem", "key": "edge.key", "authority": "ca.pem"}
        return {**{key: str(self.folder / name) for key, name in files.items()}, "first_port": port, **more}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    authority = make_authority("lab", NOW, 30)
    lab = Lab(tmp_path_factory.mktemp("certs"), authority)
    stranger = make_authority("stranger", NOW, 30)
    lab.write("ca", authority)
    lab.write("edge", issue_server(authority, ["localhost", "127.0.0.1"], NOW, 30))
    for name, role in (("operator", "operator"), ("observer", "observer"), ("plain", ""), ("chef", "chef")):
        lab.write(name, issue_client(authority, name, role, NOW, 30))
    lab.write("expired", issue_client(authority, "expired", "operator", NOW - timedelta(days=10), 9))
    lab.write("foreign", issue_client(stranger, "foreign", "operator", NOW, 30))
    # A server certificate is not valid for a client.
    lab.write("server", issue_server(authority, ["localhost"], NOW, 30))
    return lab


@pytest.fixture
def rig(lab: Lab) -> Iterator[EdgeRig]:
    port = free_ports(1)
    with running_edge(tls=lab.tls(port)) as rig:
        yield rig


def talk(rig: EdgeRig, context: ssl.SSLContext, *requests: bytes) -> list[bytes]:
    """Return the PDUs of the responses; raises `OSError` if the edge rejects the certificate."""
    with connected(rig, context) as secured:
        return [ask(secured, request) for request in requests]


def test_operator_reads_and_writes(rig: EdgeRig, lab: Lab) -> None:
    answers = talk(rig, lab.client("operator"), WRITE, READ)
    assert answers == [bytes.fromhex("06 00 00 03 E8"), bytes.fromhex("03 08 03 E8 00 00 00 00 00 00")]
    assert rig.commands[-1].effort[0] == 1.0


@pytest.mark.parametrize("name", ["observer", "plain", "chef"])
def test_observer_and_unknown_roles_are_read_only(rig: EdgeRig, lab: Lab, name: str) -> None:
    answers = talk(rig, lab.client(name), READ, WRITE)
    assert answers == [bytes.fromhex("03 08 00 00 00 00 00 00 00 00"), bytes.fromhex("86 01")]
    assert "read-only" in rig.event(Event.LEASE_REFUSED).text


@pytest.mark.parametrize(("no_role", "answer"), [("operator", "06 00 00 03 E8"), ("observer", "86 01")])
def test_permission_without_role_is_configurable(lab: Lab, no_role: str, answer: str) -> None:
    port = free_ports(1)
    with running_edge(tls=lab.tls(port, no_role=no_role)) as rig:
        assert talk(rig, lab.client("plain"), WRITE) == [bytes.fromhex(answer)]


def test_clients_without_role_can_be_refused(lab: Lab) -> None:
    port = free_ports(1)
    with running_edge(tls=lab.tls(port, no_role="refuse")) as rig:
        with pytest.raises(OSError):  # noqa: PT011  # which one depends on the timing
            talk(rig, lab.client("plain"), READ)
        assert "no role" in rig.event(Event.CONNECTION_REFUSED).text
        assert talk(rig, lab.client("observer"), READ)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("expired", "expired"),
        ("foreign", "certificate"),
        ("server", "purpose"),
        ("", "peer did not return a certificate"),
    ],
)
def test_invalid_certificate_is_refused_with_reason(rig: EdgeRig, lab: Lab, name: str, reason: str) -> None:
    with pytest.raises(OSError):  # noqa: PT011  # depends on the TLS library of the client
        talk(rig, lab.client(name), READ)
    assert reason in rig.event(Event.CONNECTION_REFUSED).text
    assert rig.service.counters.refused == 1
    # The next client is served.
    assert talk(rig, lab.client("operator"), READ)


def test_connection_ends_with_its_certificate(rig: EdgeRig, lab: Lab) -> None:
    soon = datetime.now(UTC) + timedelta(seconds=1.3) - timedelta(days=1)
    lab.write("short", issue_client(lab.authority, "short", "operator", soon, 1))
    with connected(rig, lab.client("short")) as secured, connected(rig, lab.client("operator")) as other:
        assert ask(secured, WRITE) == bytes.fromhex("06 00 00 03 E8")
        assert ask(other, READ)
        assert secured.recv(1) == b""
        assert "its certificate has expired" in rig.event(Event.LEASE_LOST).text
        assert ask(other, READ)
    with pytest.raises(OSError):  # noqa: PT011  # depends on the TLS library of the client
        talk(rig, lab.client("short"), READ)


UTF8, PRINTABLE = b"\x0c", b"\x13"
OPERATOR, OBSERVER = b"\x08operator", b"\x08observer"


def client_with(lab: Lab, name: str, *values: bytes) -> ssl.SSLContext:
    """Return the context of a client whose certificate has these malformed role extensions (DER)."""
    issued = issue_client(lab.authority, name, "", NOW, 30)
    builder = (
        x509.CertificateBuilder()
        .issuer_name(lab.authority.certificate.subject)
        .subject_name(issued.certificate.subject)
        .public_key(issued.key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(NOW - timedelta(minutes=5))
        .not_valid_after(NOW + timedelta(days=1))
    )
    for value in values:
        # The builder rejects a duplicate extension.
        role = x509.Extension(ROLE_OID, critical=False, value=x509.UnrecognizedExtension(ROLE_OID, value))
        builder._extensions = [*builder._extensions, role]
    lab.write(name, Credential(builder.sign(lab.authority.key, hashes.SHA256()), issued.key))
    return lab.client(name)


@pytest.mark.parametrize(
    "roles",
    [
        pytest.param([UTF8 + OPERATOR, UTF8 + OBSERVER], id="two roles"),
        pytest.param([UTF8 + OPERATOR, UTF8 + OPERATOR], id="one role twice"),
        pytest.param([PRINTABLE + OPERATOR], id="another string type"),
        pytest.param([UTF8 + OPERATOR + b"\0"], id="trailing byte"),
        pytest.param([UTF8 + b"\x09operator"], id="truncated"),
        pytest.param([UTF8 + b"\x02\xff\xfe"], id="not UTF-8"),
        pytest.param([UTF8 + b"\x08Operator"], id="another case"),
        pytest.param([UTF8 + b"\x00"], id="empty"),
        pytest.param([b""], id="no value"),
    ],
)
def test_ambiguous_or_malformed_role_counts_as_no_role(rig: EdgeRig, lab: Lab, roles: list[bytes]) -> None:
    answers = talk(rig, client_with(lab, "odd", *roles), READ, WRITE)
    assert answers == [bytes.fromhex("03 08 00 00 00 00 00 00 00 00"), bytes.fromhex("86 01")]
    assert "lacks the role operator" in rig.event(Event.LEASE_REFUSED).text


def test_incomplete_handshake_times_out(rig: EdgeRig, lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilrig_modbus_edge.server.tls.HANDSHAKE_TIMEOUT_S", 0.2)
    with socket.create_connection(("127.0.0.1", rig.lab.tls_ports["rig1"]), timeout=5) as slow:
        slow.sendall(Handshake(lab.client("operator")).proceed(b""))
        while slow.recv(4096):
            pass
    assert "longer than 0.2 seconds" in rig.event(Event.CONNECTION_REFUSED).text
    assert talk(rig, lab.client("operator"), READ)


@pytest.mark.parametrize("sends_hello", [False, True])
def test_aborted_handshake_is_reported(
    rig: EdgeRig, lab: Lab, caplog: pytest.LogCaptureFixture, sends_hello: bool
) -> None:
    with socket.create_connection(("127.0.0.1", rig.lab.tls_ports["rig1"]), timeout=5) as leaving:
        if sends_hello:
            leaving.sendall(Handshake(lab.client("operator")).proceed(b""))
            assert leaving.recv(1)
    assert "closed the connection during the handshake" in rig.event(Event.CONNECTION_REFUSED).text
    assert talk(rig, lab.client("operator"), READ)
    gc.collect()
    # The states of the test may be late.
    assert not [record for record in caplog.records if not record.name.endswith(".outage")]


class Handshake:
    """Client side of a handshake, executed step by step."""

    def __init__(self, context: ssl.SSLContext) -> None:
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._client = context.wrap_bio(self._incoming, self._outgoing, server_hostname="localhost")
        self.done = False

    def proceed(self, received: bytes) -> bytes:
        """Return the bytes that the client sends after it has received some."""
        self._incoming.write(received)
        with suppress(ssl.SSLWantReadError):
            self._client.do_handshake()
            self.done = True
        return self._outgoing.read()


def mutated(random: Random, data: bytes) -> bytes:
    """Return the data with a byte changed, truncated, or with random bytes inserted."""
    position = random.randrange(len(data) + 1)
    how = random.randrange(4)
    if how == 0 and position < len(data):
        return data[:position] + random.randbytes(1) + data[position + 1 :]
    if how == 1:
        return data[:position]
    return data[:position] + random.randbytes(random.randint(1, 40)) + data[position:]


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_mutated_handshakes_have_no_effect_on_others(
    rig: EdgeRig, lab: Lab, caplog: pytest.LogCaptureFixture, version: ssl.TLSVersion
) -> None:
    seed = SystemRandom().randrange(2**32)
    print(f"seed {seed}")
    random = Random(seed)
    context = lab.client("operator")
    context.minimum_version = context.maximum_version = version
    for number in range(100):
        handshake = Handshake(context)
        address = "127.0.0.1", rig.lab.tls_ports["rig1"]
        with suppress(OSError), socket.create_connection(address, timeout=0.05) as client:
            received = b""
            for flight in range(4):
                sent = handshake.proceed(received)
                client.sendall(mutated(random, sent) if flight >= number % 3 else sent)
                if handshake.done:
                    break
                received = client.recv(20_000)
    assert talk(rig, context, READ)
    eventually(lambda: rig.service.counters.connections == 0)
    assert rig.service.counters.refused
    gc.collect()
    # The test publishes no states meanwhile.
    expected = {"hilrig_modbus_edge.server.listener", "hilrig_runtime.process.event_log"}
    assert {record.name for record in caplog.records} <= expected


@pytest.mark.parametrize("size", [300, 5_000, 300_000])
def test_malformed_data_after_handshake_closes_connection(
    rig: EdgeRig, lab: Lab, caplog: pytest.LogCaptureFixture, size: int
) -> None:
    with (
        socket.create_connection(("127.0.0.1", rig.lab.tls_ports["rig1"]), timeout=5) as plain,
        lab.client("operator").wrap_socket(plain, server_hostname="localhost") as secured,
    ):
        with suppress(OSError):
            secured.sendall(READ + b"\xa5" * size)
        with suppress(OSError):
            while secured.recv(4096):
                pass
    eventually(lambda: rig.service.counters.connections == 0)
    assert rig.service.counters.malformed == 1
    assert talk(rig, lab.client("operator"), READ)
    assert [record.name for record in caplog.records] == ["hilrig_modbus_edge.server.listener"]


def test_client_cannot_renegotiate(rig: EdgeRig, lab: Lab) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl (Debian's package of that name)")
    address = f"localhost:{rig.lab.tls_ports['rig1']}"
    files = ["-CAfile", "ca.pem", "-cert", "operator.pem", "-key", "operator.key"]
    command = ["openssl", "s_client", "-tls1_2", "-connect", address, *files]
    done = subprocess.run(command, check=False, cwd=lab.folder, input="R\n", capture_output=True, text=True, timeout=10)
    assert "RENEGOTIATING" in done.stderr
    assert "no renegotiation" in done.stderr


def test_client_without_tls_is_refused_without_delay(rig: EdgeRig, lab: Lab) -> None:
    port = rig.lab.tls_ports["rig1"]
    with socket.create_connection(("127.0.0.1", port), timeout=5) as plain:
        plain.sendall(READ)
        assert talk(rig, lab.client("operator"), READ)
        plain.settimeout(5)
        while plain.recv(100):
            pass
    assert "TLS handshake failed" in rig.event(Event.CONNECTION_REFUSED).text


def test_unfinished_handshakes_take_no_place(lab: Lab) -> None:
    """Many addresses connect and never complete a handshake: the owner writes, and their number is limited."""
    port = free_ports(1)
    with running_edge(tls=lab.tls(port), max_connections=4, max_connections_per_host=2) as rig, ExitStack() as idlers:
        hello = Handshake(lab.client("operator")).proceed(b"")
        opened = []
        for number in range(24):
            source = (f"127.0.2.{number % 8}", 0)
            one = socket.create_connection(("127.0.0.1", port), timeout=5, source_address=source)
            opened.append(idlers.enter_context(one))
            if number % 2:
                one.sendall(hello)
        context = lab.client("operator")
        with connected(rig, context) as owner:
            assert ask(owner, WRITE) == bytes.fromhex("06 00 00 03 E8")
            for _ in range(3):
                assert talk(rig, context, READ)
            assert ask(owner, READ)
        eventually(lambda: rig.service.counters.refused >= 20)
        assert "too many others" in rig.event(Event.CONNECTION_REFUSED).text
        assert len([one for one in opened if not is_closed(one)]) <= 4


def test_completed_handshakes_are_limited(lab: Lab) -> None:
    port = free_ports(1)
    with running_edge(tls=lab.tls(port), max_connections_per_host=2) as rig, ExitStack() as closing:
        context = lab.client("operator")
        owner = closing.enter_context(connected(rig, context))
        assert ask(owner, READ)
        # Both are admitted before one of them is a client.
        begun = [closing.enter_context(socket.create_connection(("127.0.0.1", port), timeout=5)) for _ in range(2)]
        second = closing.enter_context(context.wrap_socket(begun[0], server_hostname="localhost"))
        assert ask(second, READ)
        third = closing.enter_context(context.wrap_socket(begun[1], server_hostname="localhost"))
        with pytest.raises(OSError):  # noqa: PT011  # which one depends on the timing
            ask(third, READ)
        assert "max_connections_per_host" in rig.event(Event.CONNECTION_REFUSED).text
        assert ask(owner, READ)


@contextmanager
def connected(rig: EdgeRig, context: ssl.SSLContext) -> Iterator[ssl.SSLSocket]:
    port = rig.lab.tls_ports["rig1"]
    with (
        socket.create_connection(("127.0.0.1", port), timeout=5) as plain,
        context.wrap_socket(plain, server_hostname="localhost") as secured,
    ):
        yield secured


def ask(secured: ssl.SSLSocket, request: bytes) -> bytes:
    """Return the PDU of the response."""
    secured.sendall(request)
    answer = secured.recv(300)
    if not answer:
        raise ConnectionError("closed")
    return answer[7:]


def is_closed(connection: socket.socket) -> bool:
    """Whether the peer has closed a connection."""
    connection.setblocking(False)
    try:
        while connection.recv(4096):
            pass
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def is_served(rig: EdgeRig, lab: Lab) -> bool:
    try:
        return bool(talk(rig, lab.client("operator"), READ))
    except OSError:
        return False


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion.TLSv1_1")
def test_old_tls_versions_are_refused(rig: EdgeRig, lab: Lab) -> None:
    context = lab.client("operator")
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    assert talk(rig, context, READ)
    context.set_ciphers("ALL:@SECLEVEL=0")
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_1
    with pytest.raises(OSError):  # noqa: PT011
        talk(rig, context, READ)


def test_requests_right_after_handshake_are_answered(rig: EdgeRig, lab: Lab) -> None:
    port = rig.lab.tls_ports["rig1"]
    with (
        socket.create_connection(("127.0.0.1", port), timeout=5) as plain,
        lab.client("operator").wrap_socket(plain, server_hostname="localhost") as secured,
    ):
        secured.sendall(READ * 200)
        data = b""
        while len(data) < 17 * 200:
            data += secured.recv(5000)
    assert len(data) == 17 * 200


def test_only_tls_listens_without_plain(lab: Lab) -> None:
    port = free_ports(1)
    with running_edge(tls=lab.tls(port), plain=False) as rig:
        assert talk(rig, lab.client("operator"), READ)
        with pytest.raises(ConnectionRefusedError):
            rig.client()


def test_every_rule_of_the_page_has_a_test() -> None:
    for _, name in SECURITY_RULES:
        assert callable(globals()[name])


def test_openssl_as_a_client(rig: EdgeRig, lab: Lab) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl (Debian's package of that name)")
    files = ["-CAfile", "ca.pem", "-cert", "operator.pem", "-key", "operator.key", "-verify_return_error"]
    address = f"localhost:{rig.lab.tls_ports['rig1']}"
    command = ["openssl", "s_client", "-quiet", "-connect", address, "-servername", "localhost", *files]
    with subprocess.Popen(
        command, cwd=lab.folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as openssl:
        assert openssl.stdin is not None
        assert openssl.stdout is not None
        openssl.stdin.write(WRITE)
        openssl.stdin.flush()
        assert openssl.stdout.read(12) == WRITE
        openssl.terminate()


@pytest.mark.parametrize("key", ["certificate", "key", "authority"])
def test_unusable_file_is_reported(lab: Lab, tmp_path: Path, key: str) -> None:
    with pytest.raises(InputError, match=rf"edge\.tls\.{key}.*missing.*can't be read"):
        policy_of(lab, **{key: tmp_path / "missing"})
    wrong = tmp_path / "wrong"
    wrong.write_text("no PEM")
    with pytest.raises(InputError, match=r"wrong.*PEM"):
        policy_of(lab, **{key: wrong})


def policy_of(lab: Lab, **files: Path) -> None:
    tls = lab.tls(1) | {key: str(path) for key, path in files.items()}
    TlsPolicy(TlsConfig.model_validate(tls))


def test_encrypted_key_is_rejected_without_prompt(lab: Lab, tmp_path: Path) -> None:
    key = tmp_path / "secret.key"
    encryption = serialization.BestAvailableEncryption(b"secret")
    private = serialization.load_pem_private_key((lab.folder / "edge.key").read_bytes(), None)
    key.write_bytes(private.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption))
    with pytest.raises(InputError, match=r"edge\.tls\.key.*secret\.key is encrypted.*openssl pkey"):
        policy_of(lab, key=key)


def test_world_readable_key_is_logged_once(lab: Lab, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    key = tmp_path / "open.key"
    key.write_bytes((lab.folder / "edge.key").read_bytes())
    key.chmod(0o600)
    policy_of(lab, key=key)
    assert not caplog.records
    key = key.rename(tmp_path / "opened.key")
    key.chmod(0o644)
    policy_of(lab, key=key)
    policy_of(lab, key=key)
    [record] = caplog.records
    assert "chmod 600" in record.getMessage()


def test_certs_creates_certificates_of_edge_and_clients(tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    made = hilrig("certs", folder, "--client", "alice=operator", "--client", "bob", "--json")
    assert made.returncode == 0, made.stderr
    bus = [f"bus/{name}" for name in ("ca", "router", "sim", "edge", "recorder", "operator", "viewer")]
    assert {str(Path(path).relative_to(folder)) for path in json.loads(made.stdout)["written"]} == {
        f"{name}.{kind}" for name in ("ca", "edge", "alice", "bob", *bus) for kind in ("pem", "key")
    }
    assert stat.S_IMODE((folder / "alice.key").stat().st_mode) == 0o600
    assert role_of(ssl.PEM_cert_to_DER_cert((folder / "alice.pem").read_text())) == "operator"
    assert role_of(ssl.PEM_cert_to_DER_cert((folder / "bob.pem").read_text())) == ""
    # A later client is signed by the same authority; no other file is changed.
    added = hilrig("certs", folder, "--client", "carol=observer", "--json")
    assert [Path(path).name for path in json.loads(added.stdout)["written"]] == ["carol.pem", "carol.key"]
    port = free_ports(1)
    files = Lab(folder, make_authority("unused", NOW, 1))
    with running_edge(tls=files.tls(port)) as rig:
        assert talk(rig, files.client("alice"), WRITE) == [bytes.fromhex("06 00 00 03 E8")]
        assert talk(rig, files.client("carol"), WRITE) == [bytes.fromhex("86 01")]


def written(folder: Path, *arguments: str | Path) -> set[str]:
    done = hilrig("certs", folder, *arguments, "--json")
    assert done.returncode == 0, done.stderr
    return {Path(path).relative_to(folder).with_suffix("").as_posix() for path in json.loads(done.stdout)["written"]}


def test_certs_recreates_only_invalid_certificates(tmp_path: Path) -> None:
    folder, lab_file = tmp_path / "certs", tmp_path / "lab.toml"
    everything = written(folder)
    assert written(folder) == set()
    # A missing host name, an edge without certificate, a certificate that expires soon.
    assert written(folder, "--host", "rig.example") == {"edge", "bus/router"}
    lab_file.write_text('[bus.tls]\nedges = {east = ["rig1"]}\n')
    assert written(folder, "--config", lab_file, "--host", "rig.example") == {"bus/east"}
    assert written(folder, "--days", "20000", "--host", "rig.example") == set()
    (folder / "bus/sim.key").unlink()
    assert written(folder, "--host", "rig.example") == {"bus/sim"}
    assert written(folder, "--renew") == everything - {"ca", "bus/ca"}


def test_expiring_certificate_is_recreated(tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    written(folder)
    soon = issue_client(make_authority("lab", NOW, 30), "observer", "observer", NOW, 20)
    (folder / "observer.pem").write_bytes(soon.certificate_pem)
    (folder / "observer.key").write_bytes(soon.key_pem)
    assert written(folder) == {"observer"}


def test_renewal_keeps_the_host_names(tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    written(folder, "--host", "rig.example")
    before = {name: names_of(folder / f"{name}.pem") for name in ("edge", "bus/router")}
    assert all("rig.example" in names for names in before.values())
    written(folder, "--renew")
    assert {name: names_of(folder / f"{name}.pem") for name in before} == before


def names_of(path: Path) -> set[str]:
    return names_in(x509.load_pem_x509_certificate(path.read_bytes()))


@pytest.mark.parametrize("missing", ["ca.key", "bus/ca.key", "bus/ca.pem"])
def test_incomplete_authority_prevents_any_change(tmp_path: Path, missing: str) -> None:
    """A host has `ca.pem` without its key: a new authority there would invalidate all other certificates."""
    folder = tmp_path / "certs"
    written(folder)
    (folder / missing).unlink()
    before = {path: path.read_bytes() for path in folder.rglob("*.*")}
    done = hilrig("certs", folder, "--renew")
    assert done.returncode == 2
    assert f"has no {Path(missing).name} in the same folder" in done.stderr
    assert {path: path.read_bytes() for path in folder.rglob("*.*")} == before


def test_host_with_bus_certificates_gets_no_authority(tmp_path: Path) -> None:
    written(tmp_path / "made")
    (tmp_path / "host/bus").mkdir(parents=True)
    for name in ("ca.pem", "sim.pem", "sim.key"):
        (tmp_path / "host/bus" / name).write_bytes((tmp_path / "made/bus" / name).read_bytes())
    assert hilrig("certs", tmp_path / "host").returncode == 2
    assert not list((tmp_path / "host").glob("*.*"))


def test_invalid_certificate_files_are_reported(tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    written(folder)
    (folder / "bus/ca.key").write_text("no key")
    done = hilrig("certs", folder)
    assert done.returncode == 2
    assert "bus/ca.pem, ca.key: not a valid certificate with its key" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "what"),
    [(["--client", "a/b"], "--client a/b"), (["--client", "x=king"], "operator or observer")],
)
def test_invalid_arguments_are_reported(tmp_path: Path, arguments: list[str], what: str) -> None:
    done = hilrig("certs", tmp_path / "certs", *arguments)
    assert done.returncode == 2
    assert what in done.stderr
    assert "Traceback" not in done.stderr
