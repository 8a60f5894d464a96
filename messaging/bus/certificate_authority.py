"""A certificate authority of one's own, in a folder: it says who is who on the bus.

ca.pem            its certificate: every process has it
ca.key            its key: with it anybody can be made anybody, so it stays away from the processes' machines
names             whom routers let in, one a line; a name that is struck out is revoked (and is not to be used again)
NAME.pem, .key    a process's certificate (its name is the common name) and key

Keys are on the curve P-256, in PKCS #8 without a password, readable by their owner alone.
"""

from __future__ import annotations

import datetime
import ipaddress
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
from brakeline.messaging.bus.identity import SERVERS, certificate_file, key_file, role_of

DAYS = 365  # that a certificate is valid; the authority's ten times as long
EARLIER = datetime.timedelta(days=1)  # certificates are valid from then on: clocks differ, by hours at times
HERE = ("localhost", "127.0.0.1", "::1")


class Authority:
    """The authority in `folder`, which is made if there is none yet."""

    def __init__(self, folder: Path, days: int = DAYS) -> None:
        """days: that the certificates are valid which it is going to issue.

        Raises:
            BadKeys: there is a certificate of one in the folder, but not its key.
        """
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
            self._key, self._certificate = self._founded()

    def issue(self, name: str, hosts: Iterable[str] = ()) -> None:
        """A certificate and a key for a process, in place of those it may have had; its name goes on the list.

        hosts: names and addresses at which others reach it, besides this machine's, if it may be a router.

        Raises:
            ValueError: the name begins with no role.
        """
        role = role_of(name)
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role in SERVERS:
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        key = ec.generate_private_key(ec.SECP256R1())
        builder = (
            self._begun(name, key, self.days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        )
        if role in SERVERS:
            reached = dict.fromkeys((*HERE, socket.gethostname(), *hosts))
            builder = builder.add_extension(x509.SubjectAlternativeName([_general(h) for h in reached]), critical=False)
        certificate = builder.sign(self._key, hashes.SHA256())
        write_secret(key_file(self.folder, name), _pem(key))
        write_atomically(certificate_file(self.folder, name), certificate.public_bytes(Encoding.PEM))
        listed = self.folder / "names"
        names = listed.read_text().split() if listed.exists() else []
        write_atomically(listed, "".join(f"{n}\n" for n in dict.fromkeys((*names, name))).encode())

    def _founded(self) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
        """A new authority, written down."""
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        key = ec.generate_private_key(ec.SECP256R1())
        signs = dict.fromkeys(
            ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"), False
        ) | dict.fromkeys(("key_agreement", "encipher_only", "decipher_only"), False)
        certificate = (
            self._begun("brakeline", key, 10 * self.days, key)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **signs), critical=True)
            .sign(key, hashes.SHA256())
        )
        write_secret(self.folder / "ca.key", _pem(key))
        write_atomically(self.folder / "ca.pem", certificate.public_bytes(Encoding.PEM))
        return key, certificate

    def _begun(
        self, name: str, key: ec.EllipticCurvePrivateKey, days: int, issuer: ec.EllipticCurvePrivateKey | None = None
    ) -> x509.CertificateBuilder:
        """A certificate of a name and a key; issuer: itself, where given."""
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
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
