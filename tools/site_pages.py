# SPDX-License-Identifier: Apache-2.0
"""Lay out in a folder what `make docs` makes a site of: pages where they lie, and the reference.

The reference is written from what the programs themselves declare: parameters of the nodes, help of
the commands, definitions of the messages. Run with the nodes' Python and ROS (tools/with_ros).
"""

import contextlib
import io
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE", "docs")
LINKED = ("config", "launch", "bench", "msg_defs")  # that pages lead to, shown as they are
NUMERIC = (
    "kinematics", "estimation", "identification", "thermal", "tool", "hand_eye", "correction",
    "motion",
)  # fmt: skip
KINDS = {"msg": "Messages", "srv": "Services", "action": "Actions"}


def nodes() -> list[Any]:
    """The class of every executable node, in the order of their names."""
    from robocal_ros.ros.base import HouseNode

    text = (ROOT / "setup.py").read_text()
    modules = sorted(re.findall(r'"\w+_node = (robocal_ros[\w.]+):main"', text))
    found = []
    for name in modules:
        members = vars(import_module(name)).values()
        classes = [c for c in members if isinstance(c, type) and issubclass(c, HouseNode)]
        (own,) = [c for c in classes if c.__module__ == name and "NAME" in vars(c)]
        found.append(own)
    return sorted(found, key=lambda node: node.NAME)


def parameters() -> str:
    """A table of each node's parameters."""
    from robocal_ros.ros.base import AUTOSTART, SERIAL

    parts = [
        "# Parameters of the nodes",
        "As the nodes declare them; `ros2 param describe` says the same. Those that are live may "
        "change while a node works, all others while it is unconfigured.",
    ]
    for node in nodes():
        rows = ["| parameter | default | allowed | meaning |", "|---|---|---|---|"]
        for setting in (AUTOSTART, SERIAL, *node.SETTINGS):
            cells = [
                f"`{setting.name}`", f"`{setting.default}` {setting.unit}".strip(), setting.bounds,
                setting.description + " (live)" * setting.live + " (advanced)" * setting.advanced,
            ]  # fmt: skip
            rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts += [f"## {node.NAME}", "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def commands() -> str:
    """The help of each command and action."""
    from robocal_ros.cli.commands import COMMANDS, CliGroup
    from robocal_ros.cli.main import main

    os.environ["COLUMNS"] = "100"
    parts = ["# Commands", "As `robocal … --help` prints it."]
    for name, command in COMMANDS.items():
        actions = list(command.actions) if isinstance(command, CliGroup) else []
        for level, words in ((2, [name]), *((3, [name, action]) for action in actions)):
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                main([*words, "--help"])
            parts += [
                f"{'#' * level} robocal {' '.join(words)}",
                f"```text\n{printed.getvalue()}```",
            ]
    return "\n\n".join(parts) + "\n"


def interfaces() -> str:
    """Every message, service and action, as it is defined."""
    parts = [
        "# Interfaces",
        "Of the package `robocal_msgs`. Fields and numbers are only ever added.",
    ]
    for kind, title in KINDS.items():
        parts.append(f"## {title}")
        for path in sorted((ROOT / "msg_defs" / kind).iterdir()):
            parts += [f"### {path.stem}", f"```text\n{path.read_text().rstrip()}\n```"]
    return "\n\n".join(parts) + "\n"


def documents() -> str:
    """What each command prints as JSON, field by field, of the schemas."""
    parts = [
        "# JSON documents",
        "Of `--json`, as the [schemas](../docs/schemas/common.json) tell programs. "
        "A field that may be missing has a `?`; [parts](#common) are told once.",
    ]
    for path in sorted((ROOT / "docs" / "schemas").glob("*.json")):
        schema = json.loads(path.read_text())
        parts += [f"## {path.stem}", schema["title"]]
        told = schema if "properties" in schema else schema.get("else", {})
        for name, part in {"": told, **schema.get("$defs", {})}.items():
            if rows := [*fields(part)]:
                parts += [f"**{name}**: {part.get('description', '')}"] if name else []
                parts.append("\n".join(["| field | type | meaning |", "|---|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def fields(schema: dict[str, Any], before: str = "") -> Iterator[str]:
    """A row of each field of an object and of those within it."""
    needed = {*schema.get("required", ()), *schema.get("else", {}).get("required", ())}
    for name, told in schema.get("properties", {}).items():
        inner, path = told, f"{before}{name}{'' if name in needed else '?'}"
        cells = [f"`{path}`", type_of(told), told.get("description", "")]
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
        while isinstance(deeper := inner.get("items", inner.get("additionalProperties")), dict):
            inner, path = deeper, path + ("[]" if "items" in inner else ".*")
        yield from fields(inner, f"{path}.")


def type_of(schema: dict[str, Any]) -> str:
    """A type in words."""
    if "$ref" in schema:
        file, _, name = schema["$ref"].partition("#/$defs/")
        return f"[{name}](#{'common' if file == 'common.json' else ''})" if file else name
    if values := schema.get("enum", [schema["const"]] if "const" in schema else []):
        return ", ".join(f"`{json.dumps(value)}`" for value in values)
    if "anyOf" in schema:
        return " or ".join(map(type_of, schema["anyOf"]))
    types = schema.get("type", "any")
    plain, *null = [types] if isinstance(types, str) else types
    if plain == "array":
        size = f"{schema['minItems']} " if "maxItems" in schema else ""
        plain = f"array of {size}({type_of(schema['items'])})"
    bounds = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    plain += "".join(f" {sign} {schema[key]}" for key, sign in bounds.items() if key in schema)
    return " or ".join((plain, *null))


def numeric(room: str) -> str:
    """What a room computes with, file by file, as its docstrings say; mkdocstrings reads them.

    Not its commands, nor what knows ROS: `parameters`, `commands` and `interfaces` have these.
    """
    files = sorted((ROOT / "robocal_ros" / room).glob("*.py"))
    texts = {path: path.read_text() for path in files if path.stem not in ("__init__", "documents")}
    of_ros = re.compile(r"^\s*(?:from|import) (?:\w+_msgs|rclpy|robocal_ros\.(?:ros|cli))\b", re.M)
    shown = [path.stem for path, text in texts.items() if not of_ros.search(text)]
    parts = [f"# robocal_ros.{room}", *(f"::: robocal_ros.{room}.{stem}" for stem in shown)]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Lay it out in the folder that is given."""
    folder = Path(sys.argv[1])
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    ignored = shutil.ignore_patterns("__pycache__", "*.py", "results")
    for name in (*PAGES, *LINKED):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=None if name == "launch" else ignored)
        else:
            shutil.copy(source, folder / name)
    reference = folder / "reference"
    (reference / "api").mkdir(parents=True)
    for name, text in (
        ("parameters", parameters()), ("commands", commands()), ("interfaces", interfaces()),
        ("documents", documents()),
        *((f"api/{room}", numeric(room)) for room in NUMERIC),
    ):  # fmt: skip
        (reference / f"{name}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
