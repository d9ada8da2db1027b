# SPDX-License-Identifier: Apache-2.0
"""Certificates and users of the bridge to a PLC: ``robocal plc certificates`` and ``user``."""

import argparse
import getpass
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.main import CliResult, Document, print_output, print_table, print_words
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

_DAYS = 1825  # five years
_ROLES = ("operator", "engineer")


def add_certificates(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of certificates and users")
    parser.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="NAME",
        help="name or address by which the PLC reaches this machine, besides its host name; "
        "may be given again",
    )
    parser.add_argument(
        "--client",
        default="",
        metavar="NAME",
        help="make one for a client that makes none itself, and trust it",
    )
    parser.add_argument(
        "--days", type=int, default=_DAYS, help=f"valid for so long, default {_DAYS}"
    )


def run_certificates(args: argparse.Namespace) -> CliResult:
    access = _access()
    if not 1 <= args.days <= 36_500:
        raise InputError(f"--days {args.days} is not 1 to 36500")
    if args.client:
        access.read_certificate(args.folder / access.SERVER)  # a folder that is complete
        path = access.make_client_certificate(args.folder, args.client, args.days)
    else:
        path = access.make_server_certificate(args.folder, args.host, args.days)
    return CliResult({"output": str(path), **access.document(args.folder)}, _show)


def add_user(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of certificates and users")
    parser.add_argument("name", metavar="NAME", help="name of the user")
    parser.add_argument(
        "--role",
        choices=_ROLES,
        default=_ROLES[0],
        help="operator (default) reads, gives the gap and runs cycles; engineer also decides",
    )
    parser.add_argument("--remove", action="store_true", help="take the user out")


def run_user(args: argparse.Namespace) -> CliResult:
    access = _access()
    access.read_certificate(args.folder / access.SERVER)  # a folder that is complete
    users = access.Users(args.folder)
    if args.remove:
        users.remove(args.name)
    else:
        users.put(args.name, access.Role[args.role.upper()], _password(args.name))
    return CliResult(
        {"output": str(args.folder / access.USERS), **access.document(args.folder)}, _show
    )


def _access() -> Any:
    """The room's file, which needs a library that not everybody has."""
    try:
        from robocal_ros.plc import access
    except ImportError as error:
        raise InputError(f"{error}: pip install 'robocal_ros[plc]'") from error
    return access


def _password(name: str) -> str:
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    password = getpass.getpass(f"Password of {name}: ")
    if getpass.getpass("Again: ") != password:
        raise InputError("the two passwords differ")
    return password


def _show(console: "Console", document: Document) -> None:
    print_output(console, document)
    print_words(console, f"{document['application_uri']}, valid until {document['valid_until']}")
    print_table(console, "Users", ("name", "role"), [*document["users"].items()], (0, 1))
    print_words(console, f"Trusted: {', '.join(document['trusted']) or 'nobody'}")
