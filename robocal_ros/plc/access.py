# SPDX-License-Identifier: Apache-2.0
"""Who may talk to the cell: users with hashed passwords and roles, clients with certificates.

All of it lies in one folder: ``server.der`` and ``server_key.pem``, the PLCs' certificates in
``trusted/``, those that were turned away in ``rejected/``, made ones in ``clients/``, and
``users.json``. It is read anew at each login.
"""

import hashlib
import hmac
import json
import os
import secrets
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted, read_bytes, read_text, write_bytes

SERVER, KEY, USERS = "server.der", "server_key.pem", "users.json"
TRUSTED, REJECTED, CLIENTS = "trusted", "rejected", "clients"
MOST_REJECTED = 20  # certificates that are kept for a person to look at
KEY_BITS = 2048  # the least that Basic256Sha256 takes (OPC 10000-7), and quick for a PLC
SCRYPT = {"n": 2**14, "r": 8, "p": 1}  # RFC 7914; 16 MB and some 50 ms for each guess
SHORTEST_PASSWORD, LONGEST = 10, 100
LONGEST_CLIENT = 64  # of a common name (RFC 5280, appendix A)
LOCKED_AFTER, LOCKED_S = 5, 10.0  # wrong passwords of a name, and how long nobody has it then
FILE_VERSION = 1


class Role(IntEnum):
    """What a user may do; the higher one includes the lower."""

    OPERATOR = 1
    """Reads, gives the gap and runs cycles: the PLC's own user, too."""
    ENGINEER = 2
    """Also decides: accept, reject, roll back, acknowledge."""


@dataclass(frozen=True)
class Account:
    """A user as kept: no password, but what it hashes to."""

    role: Role
    salt: bytes
    digest: bytes


def _digest(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, **SCRYPT)


class Users:
    """The users of a folder.

    Raises `InputError` when the file is no table of users; none at all is no error.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / USERS
        self.accounts: dict[str, Account] = {}
        if not self._path.exists():
            return
        try:
            document = json.loads(read_text(self._path, "table of users"))
            if document["version"] != FILE_VERSION:
                raise ValueError(f"version {document['version']} is of another software")
            for name, kept in document["users"].items():
                salt, digest = bytes.fromhex(kept["salt"]), bytes.fromhex(kept["digest"])
                self.accounts[name] = Account(Role[kept["role"].upper()], salt, digest)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                f"is no table of users ({error}): make it anew with robocal plc user",
                file=str(self._path),
            ) from error

    def put(self, name: str, role: Role, password: str) -> None:
        """Add a user, or give another password or role. Raises `InputError` for what is none."""
        if not name or len(name) > LONGEST or not name.isprintable():
            raise InputError(f"{quoted(name)} is no name of a user: 1 to {LONGEST} printable signs")
        if not SHORTEST_PASSWORD <= len(password) <= LONGEST:
            raise InputError(
                f"a password has {SHORTEST_PASSWORD} to {LONGEST} signs, this one {len(password)}"
            )
        salt = secrets.token_bytes(16)
        self.accounts[name] = Account(role, salt, _digest(password, salt))
        self._save()

    def remove(self, name: str) -> None:
        """Take a user out. Raises `InputError` where there is none."""
        if name not in self.accounts:
            known = ", ".join(sorted(self.accounts)) or "nobody"
            raise InputError(
                f"{quoted(name)} is no user here; there is {known}", file=str(self._path)
            )
        del self.accounts[name]
        self._save()

    def login(self, name: str, password: str) -> Account | None:
        """The account, where the password is right; a name that nobody has takes as long."""
        account = self.accounts.get(name)
        salt = account.salt if account else b"\0" * 16
        digest = _digest(password[: 4 * LONGEST], salt)
        right = account is not None and hmac.compare_digest(digest, account.digest)
        return account if right else None

    def _save(self) -> None:
        users = {
            name: {"role": a.role.name.lower(), "salt": a.salt.hex(), "digest": a.digest.hex()}
            for name, a in sorted(self.accounts.items())
        }
        document = {"version": FILE_VERSION, "users": users}
        write_private(self._path, json.dumps(document, indent=1).encode())


class Logins:
    """Logins of a folder's users; who guesses a name's password is locked out for a while."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._wrong: dict[str, list[float]] = {}

    def login(self, name: str, password: str, now_s: float) -> Account | str:
        """The account, or why there is none, in words; ``now_s``: steady clock."""
        name = name[:LONGEST]
        wrong = [at_s for at_s in self._wrong.get(name, ()) if now_s - at_s < LOCKED_S]
        if len(wrong) >= LOCKED_AFTER:
            return f"login of {quoted(name)} is locked: {len(wrong)} wrong passwords"
        try:
            account = Users(self._folder).login(name, password)
        except InputError as error:
            return f"nobody can log in: {error}"
        if account is None:
            lately = {of: at for of, at in self._wrong.items() if now_s - at[-1] < LOCKED_S}
            self._wrong = lately | {name: [*wrong, now_s]}  # of a guess each 50 ms at the most
            return f"login of {quoted(name)} is refused: no such user, or password"
        self._wrong.pop(name, None)
        return account


def write_private(path: Path, data: bytes) -> None:
    """Write a file that its owner alone can read, whole or not at all. Raises `InputError`."""
    before = os.umask(0o177)
    try:
        write_bytes(path, data, durable=True)
    finally:
        os.umask(before)


# ---- certificates -------------------------------------------------------------------------------


def made_certificate(name: str, uri: str, hosts: Sequence[str], days: int) -> tuple[bytes, bytes]:
    """A self-signed application instance certificate, DER, and its key, PEM without a password.

    With what OPC 10000-6, 6.2.2 asks for: the application's URI and its hosts as alternative
    names, both ends' uses. ``hosts``: names or addresses. Raises `InputError` for a name that is
    not ASCII.
    """
    key = rsa.generate_private_key(public_exponent=65537, key_size=KEY_BITS)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    alternatives: list[x509.GeneralName] = [x509.UniformResourceIdentifier(uri)]
    for host in hosts:
        try:
            alternatives.append(x509.IPAddress(ip_address(host)))
        except ValueError:
            if not host.isascii():
                raise InputError(f"{quoted(host)}: write it as its A-label, xn--...") from None
            alternatives.append(x509.DNSName(host))
    now = datetime.now(UTC)
    uses = dict.fromkeys(
        ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment"), True
    ) | dict.fromkeys(("key_agreement", "crl_sign", "encipher_only", "decipher_only"), False)
    ends = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    public = key.public_key()
    certificate = (
        x509.CertificateBuilder(subject, subject, public, x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))  # a PLC's clock may be behind
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        # of a self-signed one, whoever checks it takes it for its issuer
        .add_extension(x509.KeyUsage(key_cert_sign=True, **uses), critical=True)
        .add_extension(x509.ExtendedKeyUsage(ends), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return certificate.public_bytes(serialization.Encoding.DER), pem


def make_server_certificate(folder: Path, hosts: Sequence[str], days: int) -> Path:
    """The server's certificate and key in a folder, which is made with its sub-folders.

    Raises `InputError` where there is one already: whoever trusts it would not trust another.
    """
    for part in (TRUSTED, REJECTED, CLIENTS):
        (folder / part).mkdir(parents=True, exist_ok=True, mode=0o700)
    path = folder / SERVER
    if path.exists():
        raise InputError(
            "is there already, and what trusts it would not trust another: remove it, and "
            f"{KEY}, to make them anew",
            file=str(path),
        )
    host = socket.gethostname()
    names = [host, *hosts]
    der, key = made_certificate(
        "robocal plc_bridge_node", f"urn:{host}:robocal_ros:plc_bridge", names, days
    )
    write_private(folder / KEY, key)
    write_bytes(path, der, durable=True)
    return path


def make_client_certificate(folder: Path, name: str, days: int) -> Path:
    """Certificate and key for a client that makes none itself; it is trusted here.

    Raises `InputError` where there is one of this name, or it is none of a file.
    """
    plain = name.isascii() and name.replace("-", "").replace("_", "").isalnum()
    if not plain or len(name) > LONGEST_CLIENT:
        words = f"up to {LONGEST_CLIENT} letters of ASCII, digits, - and _"
        raise InputError(f"{quoted(name)} is no name of a client: {words}")
    path = folder / CLIENTS / f"{name}.der"
    if path.exists():
        raise InputError("is there already: remove it to make it anew", file=str(path))
    der, key = made_certificate(name, f"urn:robocal_ros:client:{name}", [name], days)
    write_private(path.with_name(f"{name}_key.pem"), key)
    write_bytes(path, der)
    write_bytes(folder / TRUSTED / f"{name}.der", der)
    return path


def read_certificate(path: Path) -> x509.Certificate:
    """Of DER or PEM. Raises `InputError`."""
    data = read_bytes(path, "certificate")
    try:
        if data.startswith(b"-----"):
            return x509.load_pem_x509_certificate(data)
        return x509.load_der_x509_certificate(data)
    except ValueError as error:
        raise InputError(f"is no certificate (DER or PEM): {error}", file=str(path)) from error


def application_uri(certificate: x509.Certificate) -> str:
    """The application's URI. Raises `InputError` where it has none."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        return str(names.get_values_for_type(x509.UniformResourceIdentifier)[0])
    except (x509.ExtensionNotFound, IndexError) as error:
        raise InputError("the certificate has no application URI among its names") from error


def certified_hosts(certificate: x509.Certificate) -> frozenset[str]:
    """Names of the machine that it is for; none where it names none."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return frozenset()
    return frozenset(names.get_values_for_type(x509.DNSName))


class Trust:
    """Which clients' certificates are trusted: those in ``trusted/``, to the byte, while valid.

    No certificate authority: a PLC's own certificate is put there by a person.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def refusal(self, sent: bytes) -> str:
        """Why a client with this certificate (DER) is turned away.

        Empty: it is trusted. One that is not is kept in ``rejected/``.
        """
        try:
            found = x509.load_der_x509_certificate(sent)
        except ValueError:
            return "its certificate cannot be read"
        der = found.public_bytes(serialization.Encoding.DER)
        thumbprint = hashlib.sha1(der, usedforsecurity=False).hexdigest()
        words = f"certificate {thumbprint[:16]} of {found.subject.rfc4514_string() or 'nobody'}"
        if not any(der == known for known in self._trusted()):
            kept = self._folder / REJECTED / f"{thumbprint}.der"
            if not kept.exists():
                if len([*kept.parent.glob("*.der")]) >= MOST_REJECTED:
                    return f"{words} is not trusted, and {REJECTED}/ is full: empty it, try again"
                write_bytes(kept, der)
            return f"{words} is not trusted: move {REJECTED}/{kept.name} to {TRUSTED}/ to trust it"
        now = datetime.now(UTC)
        if not found.not_valid_before_utc <= now <= found.not_valid_after_utc:
            return (
                f"{words} is valid from {found.not_valid_before_utc:%Y-%m-%d} to "
                f"{found.not_valid_after_utc:%Y-%m-%d}: renew it, or set this machine's clock"
            )
        return ""

    def _trusted(self) -> list[bytes]:
        certificates = []
        for path in sorted((self._folder / TRUSTED).glob("*")):
            try:
                certificates.append(read_certificate(path).public_bytes(serialization.Encoding.DER))
            except InputError:
                continue  # a list of revocations, a note of a person
        return certificates


def document(folder: Path) -> Mapping[str, Any]:
    """What is in a folder, for a person: users with roles, the server's certificate."""
    certificate = read_certificate(folder / SERVER)
    return {
        "application_uri": application_uri(certificate),
        "valid_until": f"{certificate.not_valid_after_utc:%Y-%m-%d}",
        "users": {name: a.role.name.lower() for name, a in Users(folder).accounts.items()},
        "trusted": sorted(path.name for path in (folder / TRUSTED).glob("*")),
    }
