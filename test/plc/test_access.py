# SPDX-License-Identifier: Apache-2.0
"""Users and certificates: what is kept, who is let in, what cannot be read."""

import json
import stat
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from bench.live.opc_ua import OPERATOR, security_folder
from robocal_ros.ground.errors import InputError
from robocal_ros.plc import access
from robocal_ros.plc.access import Role, Trust, Users


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return security_folder(tmp_path_factory.mktemp("plc"))


def test_a_password_is_kept_as_a_hash_that_its_owner_alone_reads(folder):
    text = (folder / access.USERS).read_text()
    assert OPERATOR[1] not in text
    for name in (access.USERS, access.KEY, f"{access.CLIENTS}/line_key.pem"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600
    users = Users(folder)
    assert users.login(*OPERATOR) == users.accounts["plc"]
    assert users.accounts["plc"].role is Role.OPERATOR
    assert users.login("ada", "an engineer's password").role is Role.ENGINEER
    for name, password in (
        ("plc", ""),
        ("plc", "a plc's Password"),
        ("eve", OPERATOR[1]),
        ("", ""),
    ):
        assert users.login(name, password) is None
    salts = {kept["salt"] for kept in json.loads(text)["users"].values()}
    assert len(salts) == 2


def test_what_is_no_user_or_password_is_refused(tmp_path):
    users = Users(tmp_path)
    for name, password in (
        ("", "x" * 10),
        ("a\nb", "x" * 10),
        ("a" * 101, "x" * 10),
        ("a", "short"),
    ):
        with pytest.raises(InputError):
            users.put(name, Role.OPERATOR, password)
    with pytest.raises(InputError, match="'bob' is no user here; there is nobody"):
        users.remove("bob")
    assert not (tmp_path / access.USERS).exists()


@pytest.mark.parametrize(
    "text",
    ["[]", "{}", "nonsense", '{"version": 2, "users": {}}',
     '{"version": 1, "users": {"a": {"role": "king", "salt": "", "digest": ""}}}',
     '{"version": 1, "users": {"a": {"role": "operator", "salt": "zz", "digest": ""}}}'],
)  # fmt: skip
def test_a_table_of_users_that_makes_no_sense_lets_nobody_in(tmp_path, text):
    (tmp_path / access.USERS).write_text(text)
    with pytest.raises(InputError, match=r"users\.json"):
        Users(tmp_path)


def test_certificates_are_as_opc_ua_wants_them(folder):
    """OPC 10000-6, 6.2.2: the application's URI, both uses, RSA of 2048 bits or more, SHA-256."""
    for path in (folder / access.SERVER, folder / access.CLIENTS / "line.der"):
        certificate = access.read_certificate(path)
        assert access.application_uri(certificate).startswith("urn:")
        assert certificate.public_key().key_size >= 2048
        assert certificate.signature_hash_algorithm.name == "sha256"
        usage = certificate.extensions.get_extension_for_class(x509.KeyUsage).value
        assert usage.digital_signature
        assert usage.content_commitment
        assert usage.key_encipherment
        assert usage.data_encipherment
        now = datetime.now(UTC)
        assert certificate.not_valid_before_utc < now < certificate.not_valid_after_utc
    names = access.read_certificate(folder / access.SERVER).extensions
    hosts = names.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "localhost" in hosts.get_values_for_type(x509.DNSName)


def test_nothing_is_made_over_what_is_there(folder):
    before = (folder / access.SERVER).read_bytes()
    with pytest.raises(InputError, match="is there already"):
        access.make_server_certificate(folder, [], 30)
    with pytest.raises(InputError, match="is there already"):
        access.make_client_certificate(folder, "line", 30)
    assert (folder / access.SERVER).read_bytes() == before


def test_a_name_that_no_certificate_can_have_is_refused(folder, tmp_path):
    for name in ("", "../evil", "a b", "Pr\u00fcfstand", "a" * 65):
        with pytest.raises(InputError, match="is no name of a client: up to 64 letters"):
            access.make_client_certificate(folder, name, 30)
    access.make_client_certificate(folder, "a" * 64, 30)
    with pytest.raises(InputError, match="xn--"):
        access.make_server_certificate(tmp_path, ["pr\u00fcfstand.local"], 30)
    assert not (tmp_path / access.SERVER).exists()


def test_only_the_very_certificate_that_a_person_trusts_is_trusted(folder, tmp_path):
    trust = Trust(folder)
    own = (folder / access.CLIENTS / "line.der").read_bytes()
    assert trust.refusal(own) == ""
    other, _ = access.made_certificate("line", "urn:robocal_ros:client:line", ["line"], 30)
    assert "is not trusted: move rejected/" in trust.refusal(other)
    assert trust.refusal(other[:-1]) == "its certificate cannot be read"
    assert trust.refusal(b"") == "its certificate cannot be read"
    (folder / access.TRUSTED / "note.txt").write_text("of the line's PLC")
    pem = x509.load_der_x509_certificate(other).public_bytes(Encoding.PEM)
    (folder / access.TRUSTED / "other.pem").write_bytes(pem)
    assert trust.refusal(other) == ""
    (folder / access.TRUSTED / "other.pem").unlink()
    old, _ = access.made_certificate("old", "urn:old", [], -1)
    (folder / access.TRUSTED / "old.der").write_bytes(old)
    assert "renew it, or set this machine's clock" in trust.refusal(old)


def test_certificates_that_strangers_send_do_not_fill_the_disk(folder, monkeypatch):
    monkeypatch.setattr(access, "MOST_REJECTED", 2)
    for path in (folder / access.REJECTED).glob("*"):
        path.unlink()
    trust = Trust(folder)
    for number in range(4):
        stranger, _ = access.made_certificate(f"stranger {number}", "urn:stranger", [], 1)
        words = "move rejected/" if number < 2 else "rejected/ is full"  # no file that is not there
        assert words in trust.refusal(stranger)
    assert len([*(folder / access.REJECTED).glob("*.der")]) == 2
