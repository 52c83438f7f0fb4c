"""``trotd keys``: a private certificate authority and one certificate for each bearer of a role.

The authority's own key stays in its folder; a bearer gets a folder with three files and nothing else.
"""

from __future__ import annotations

import ipaddress
import os
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from runtime.access import CA, CERTIFICATE, KEY, Role, common_name
from station.session import StationError

CA_KEY = "ca-key.pem"
CA_YEARS, BEARER_YEARS = 10, 2
LOCAL = ("localhost", "127.0.0.1")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def make_authority(folder: Path, now: datetime | None = None) -> None:
    """A new authority in ``folder``: ``ca.pem`` to give away, ``ca-key.pem`` to keep.

    Raises:
        StationError: there is one already, or the folder cannot be written.
    """
    if (folder / CA_KEY).exists():
        raise StationError(f"{folder / CA_KEY}: exists; a new authority would make every certificate foreign")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "trotd authority")])
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    certificate = (
        _builder(name, name, key.public_key(), now or datetime.now(UTC), CA_YEARS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(authority=True), critical=True)
        .add_extension(identifier, critical=False)
        .sign(key, hashes.SHA256())
    )
    _write(folder, CA_KEY, _private(key))
    _write(folder, CA, certificate.public_bytes(serialization.Encoding.PEM))


def add_bearer(
    authority: Path, role: Role, name: str, hosts: tuple[str, ...] = (), now: datetime | None = None
) -> Path:
    """A certificate for one bearer, in a folder of its own inside the authority's; returns that folder.

    Args:
        authority: folder that ``make_authority`` filled.
        role: what the bearer may do.
        name: who it is, for people.
        hosts: names and addresses under which a robot is reached, beside the local ones.
        now: when it begins to hold.

    Raises:
        StationError: no authority there, a name that cannot be, a folder that exists.
    """
    if not NAME.fullmatch(name):
        raise StationError(f"name = {name!r}: letters, digits, dot, dash and underscore, 64 at most")
    folder = authority / f"{role.value}-{name}"
    if folder.exists():
        raise StationError(f"{folder}: exists")
    try:
        signer = serialization.load_pem_private_key((authority / CA_KEY).read_bytes(), None)
        root = x509.load_pem_x509_certificate((authority / CA).read_bytes())
    except OSError as error:
        raise StationError(f"{error.filename}: {error.strerror}; trotd keys init makes it") from error
    except ValueError as error:
        raise StationError(f"{authority}: {error}") from error
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, common_name(role)),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, name),
        ]
    )
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH] + ([ExtendedKeyUsageOID.SERVER_AUTH] if role is Role.ROBOT else [])
    certificate = (
        _builder(subject, root.subject, key.public_key(), now or datetime.now(UTC), BEARER_YEARS)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.SubjectAlternativeName([_host(host) for host in (*LOCAL, *hosts)]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .sign(signer, hashes.SHA256())
    )
    _write(folder, KEY, _private(key))
    _write(folder, CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM))
    _write(folder, CA, root.public_bytes(serialization.Encoding.PEM))
    return folder


def _builder(
    subject: x509.Name, issuer: x509.Name, public: ec.EllipticCurvePublicKey, now: datetime, years: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))  # clocks of robots without a battery run behind
        .not_valid_after(now + timedelta(days=365 * years))
    )


def _usage(authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(folder: Path, name: str, data: bytes) -> None:
    """A new file that only its owner reads."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        fd = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise StationError(f"{folder / name}: {error.strerror}") from error
    with os.fdopen(fd, "wb") as file:
        file.write(data)
