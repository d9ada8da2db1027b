# SPDX-License-Identifier: Apache-2.0
"""Who may do what on the page: sessions of the users that the PLC's bridge has too."""

import secrets
import ssl
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from robocal_ros.ground.errors import InputError
from robocal_ros.plc.access import KEY, SERVER, Account, Logins, Role, Users

SESSION_S = 12 * 3600.0  # a shift
ENGINEER_S = 30 * 60.0  # since the last decision: a tablet is left lying about
MOST_SESSIONS = 50

ACTS: Mapping[str, tuple[Role, str]] = {
    "run": (Role.OPERATOR, "run_trigger"),
    "cancel": (Role.OPERATOR, "cancel_trigger"),
    "accept": (Role.ENGINEER, "accept"),
    "reject": (Role.ENGINEER, "reject"),
    "acknowledge": (Role.ENGINEER, "acknowledge"),
}
"""What may be asked of maintenance_node: who may, and its service; as by OPC UA (plc.model)."""
DECISIONS = ("accept", "reject")


@dataclass
class PanelSession:
    """One browser that has logged in; ``csrf``: what its requests must carry beside the cookie."""

    user: str
    role: Role
    account: Account
    csrf: str
    since_s: float
    used_s: float

    def ended(self, now_s: float) -> bool:
        """Whether its time is over."""
        idle = self.role is Role.ENGINEER and now_s - self.used_s > ENGINEER_S
        return idle or now_s - self.since_s > SESSION_S


class PanelSessions:
    """Logins and sessions of a folder of users; times of a steady clock.

    `login`, `allowed` and `look` read the folder, and `login` computes a hash: not for an event
    loop.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._logins = folder, Logins(folder)
        self._sessions: dict[str, PanelSession] = {}

    def login(self, name: str, password: str, now_s: float) -> tuple[str, PanelSession] | str:
        """A new session with its token; or why there is none, in words."""
        account = self._logins.login(name, password, now_s)
        if isinstance(account, str):
            return account
        made = PanelSession(name, account.role, account, secrets.token_urlsafe(32), now_s, now_s)
        token = secrets.token_urlsafe(32)
        lasting = {t: s for t, s in [*self._sessions.items()] if not s.ended(now_s)}
        while len(lasting) >= MOST_SESSIONS:
            del lasting[min(lasting, key=lambda t: lasting[t].used_s)]
        self._sessions = lasting | {token: made}
        return token, made

    def of(self, token: str, now_s: float) -> PanelSession | None:
        """The session of a cookie; None: there is none any more."""
        found = self._sessions.get(token)
        if found is not None and found.ended(now_s):
            self.end(token)
            return None
        return found

    def end(self, token: str) -> None:
        """Log out."""
        self._sessions.pop(token, None)

    def look(self) -> None:
        """End the sessions of users who were taken out, or given another password or role."""
        if not self._sessions:
            return
        try:
            accounts = Users(self._folder).accounts
        except (InputError, OSError):  # nobody is known any more
            accounts = {}
        for token, session in [*self._sessions.items()]:
            if accounts.get(session.user) != session.account:
                self.end(token)

    def allowed(self, session: PanelSession, act: str, now_s: float) -> bool:
        """Whether its user may do this, by the table of users as it is now."""
        try:
            account = Users(self._folder).accounts.get(session.user)
        except InputError:
            return False
        if account != session.account or account.role < ACTS[act][0]:
            return False
        session.used_s = now_s
        return True


def encryption(folder: Path) -> ssl.SSLContext:
    """TLS by the certificate of a folder of `robocal plc certificates`. Raises `InputError`."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        with tempfile.NamedTemporaryFile("w", suffix=".pem") as pem:
            pem.write(ssl.DER_cert_to_PEM_cert((folder / SERVER).read_bytes()))
            pem.flush()
            context.load_cert_chain(pem.name, folder / KEY)
    except (OSError, ssl.SSLError) as error:
        raise InputError(
            f"{folder} has no {SERVER} with its {KEY} ({error}): make them by `robocal plc "
            "certificates`"
        ) from error
    return context
