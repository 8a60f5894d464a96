"""A certificate authority in a folder, which certifies the processes of a bus.

ca.pem            the certificate of the authority; every process needs it
ca.key            the key of the authority; whoever has it can certify any name, so keep it off the processes' machines
names             the names that routers accept, one on each line; delete a name to revoke it, and never use it again
NAME.pem, .key    the certificate of a process (its common name is NAME) and its key

Keys are on the curve P-256, in PKCS #8 without a password. Only their owner can read them.
"""

from __future__ import annotations

import datetime
import ipaddress
import re
import socket
from collections.abc import Iterable
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from brakeline.errors import BadKeys
from brakeline.messaging.atomic_files import write_atomically, write_secret
from brakeline.messaging.bus.identity import SERVERS, certificate_file, key_file, role_on_certificate

DAYS = 365  # validity of a certificate; the authority's own certificate is valid ten times as long
MOST_DAYS = 100 * DAYS
EARLIER = datetime.timedelta(days=1)  # certificates are valid from that time before now, since clocks differ
HERE = ("localhost", "127.0.0.1", "::1")
HOST = re.compile(r"(\*\.)?\w[\w.-]*", re.ASCII)  # the name of a host


class Authority:
    """The authority in a folder."""

    def __init__(self, folder: Path, days: int = DAYS) -> None:
        """Read the authority, or create it if the folder has none.

        Args:
            days: validity of the certificates that it issues.

        Raises:
            BadKeys: the folder has the certificate of an authority, but not its key.
            ValueError: certificates cannot be valid for so many days.
        """
        if not 1 <= days <= MOST_DAYS:
            raise ValueError(f"certificates are valid for 1 to {MOST_DAYS} days, not {days}")
        self.folder, self.days = folder, days
        if (folder / "ca.pem").exists():
            try:
                key = load_pem_private_key((folder / "ca.key").read_bytes(), None)
                self._certificate = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
            except (OSError, ValueError) as error:
                raise BadKeys(f"{folder}: the authority's key is not here, so it can issue nothing: {error}") from error
            if not isinstance(key, ec.EllipticCurvePrivateKey):
                raise BadKeys(f"{folder}/ca.key is no key on an elliptic curve")
            self._key = key
        else:
            self._key, self._certificate = self._create()

    def issue(self, name: str, hosts: Iterable[str] = ()) -> None:
        """Write a new certificate and key for a process, and add its name to the list.

        Args:
            hosts: names and addresses of a router besides those of this machine.

        Raises:
            ValueError: the name does not begin with a role, or cannot be on a certificate. Or a host is no name or
                address.
        """
        role = role_on_certificate(name)
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role in SERVERS:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        key = ec.generate_private_key(ec.SECP256R1())
        builder = (
            self._builder(name, key, self.days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        )
        if role in SERVERS:
            own = socket.gethostname()  # it may be a name that no certificate can hold
            reached = dict.fromkeys((*HERE, *((own,) if HOST.fullmatch(own) else ()), *hosts))
            builder = builder.add_extension(x509.SubjectAlternativeName([_general(h) for h in reached]), critical=False)
        certificate = builder.sign(self._key, hashes.SHA256())
        write_secret(key_file(self.folder, name), _pem(key))
        write_atomically(certificate_file(self.folder, name), certificate.public_bytes(Encoding.PEM))
        listed = self.folder / "names"
        names = listed.read_text().split() if listed.exists() else []
        write_atomically(listed, "".join(f"{n}\n" for n in dict.fromkeys((*names, name))).encode())

    def _create(self) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
        """Create an authority, and write its files."""
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        signs = dict.fromkeys(
            ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"), False
        ) | dict.fromkeys(("key_agreement", "encipher_only", "decipher_only"), False)
        certificate = (
            self._builder("brakeline", key, 10 * self.days, key)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **signs), critical=True)
            .sign(key, hashes.SHA256())
        )
        write_secret(self.folder / "ca.key", _pem(key))
        write_atomically(self.folder / "ca.pem", certificate.public_bytes(Encoding.PEM))
        return key, certificate

    def _builder(
        self, name: str, key: ec.EllipticCurvePrivateKey, days: int, issuer: ec.EllipticCurvePrivateKey | None = None
    ) -> x509.CertificateBuilder:
        """Return a builder of a certificate; with `issuer`, the certificate is signed by its own key."""
        now = datetime.datetime.now(datetime.UTC)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(subject if issuer is not None else self._certificate.subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - EARLIER)
            .not_valid_after(now + datetime.timedelta(days=days))
        )


def _general(host: str) -> x509.GeneralName:
    """Return a host as a certificate states it. Raises ValueError: no process would ever reach such a host."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host.removeprefix("[").removesuffix("]")))
    except ValueError:
        if HOST.fullmatch(host):
            return x509.DNSName(host)
    raise ValueError(
        f"{host!r} is no name or address of a host: give it without protocol and port, such as 10.0.0.1 or "
        "router.example.org; write the letters of other alphabets as DNS does (xn--…)"
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
