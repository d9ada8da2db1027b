# SPDX-License-Identifier: Apache-2.0
"""What of ours others rely on by name, one name a line; kept in test/public_names.txt.

    tools/with_ros python tools/public_names.py >test/public_names.txt

Of each node parameters with default and choices, topics, services and actions with their types;
commands and their options; keys of JSON documents; fields and constants of messages; what a PLC
reads and calls. A test holds the kept list against what is found, another the policies of SROS 2
against the list: what is gone or new there stands in CHANGELOG with its reason. ``git diff`` of the
list compares two commits.

Not seen are arguments of launch files, what recorder_node records and replay_node plays, the inputs
of adapter_node whose messages no wheel has, and where thermal_node looks for a sensor's frame.
"""

import argparse
import contextlib
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from site_pages import ROOT, nodes  # which has the tree on the path, too

from bench.live.opc_ua import free_port, security_folder
from robocal_ros.cell_sim.fixture import PLATE
from robocal_ros.cli.commands import COMMANDS, CliCommand, CliGroup
from robocal_ros.cli.main import CommandParser
from robocal_ros.fixture.files import fixture_document
from robocal_ros.plc.modbus import HOLDINGS, INPUTS
from robocal_ros.plc.model import METHODS, SHOWN
from robocal_ros.ros.base import AUTOSTART, SERIAL

CELL = ROOT / "config" / "cells"
LASER = {"laser": str(CELL / "kr150_laser.yaml")}
MOVES = {"follow_joint_trajectory": "follow_joint_trajectory", "hard_stop_service": "hard_stop"}
SEES_DEG = [4.97, -74.1, 98.61, 2.92, 79.56, 41.63]  # the plate, from one of the cell's poses
# With all that they may have on the graph; a node that never has all at once starts several times.
GIVEN: Mapping[str, tuple[dict[str, Any], ...]] = {
    "thermal_node": ({"arrangement": "flange-sensor"},),  # which has all of the other's
    "tcf_node": (LASER | MOVES,),
    "joint_correction_node": (MOVES,),
    "maintenance_node": (LASER | MOVES | {"fixture_poses_deg": SEES_DEG},),
    "cell_sim_node": ({"profile": True, "fixture": True, "run_program": True},),
    "plc_bridge_node": ({"beams": ["x"]},),
    "recorder_node": ({"topics": ["nothing"]},),  # it records what its parameter names
    "adapter_node": (
        {"input": "bool", "target_frame": "tag36h11:0", "profile_input": "cloud"},
        {"profile_input": "scan", "profile_frame": "scanner"},
    ),
}
ROBOT = "kr150_r3100"
NAMESPACE = "/cell"  # so that names show whether they are relative, global or the node's own


def one_of(choices: Iterable[Any] | None) -> str:
    """Behind a name; nothing where all is allowed."""
    return f" ({' | '.join(map(str, choices))})" if choices else ""


def parameters(node: Any) -> Iterator[str]:
    """Of a node's class: name, default, unit, choices."""
    for setting in (AUTOSTART, SERIAL, *node.SETTINGS):
        default = json.dumps(setting.default)
        shown = f"parameter {setting.name} = {default} {setting.unit}".rstrip()
        yield shown + one_of(setting.choices)


def endpoints(node: Any) -> Iterator[str]:
    """What a live node has on the graph, which it asks itself."""
    kinds = {
        ("publishes", ""): node.get_publisher_names_and_types_by_node,
        ("subscribes", ""): node.get_subscriber_names_and_types_by_node,
        ("serves", "executes"): node.get_service_names_and_types_by_node,
        ("requests", "calls"): node.get_client_names_and_types_by_node,
    }
    own, here = f"{NAMESPACE}/{node.get_name()}/", f"{NAMESPACE}/"
    for (does, with_action), ask in kinds.items():
        for full, types in ask(node.get_name(), NAMESPACE):
            name = (
                f"~/{full.removeprefix(own)}" if full.startswith(own) else full.removeprefix(here)
            )
            name, _, part = name.partition("/_action/")
            if not part:
                yield f"{does} {name} {' '.join(types)}"
            elif part == "send_goal" and with_action:
                yield f"{with_action} {name} {types[0].removesuffix('_SendGoal')}"


def graph() -> dict[str, set[str]]:
    """Endpoints of each node, by name; all of them live in one process."""
    context = Context()
    rclpy.init(args=[], context=context)
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as alive:
        folder = Path(name)
        os.environ["ROBOCAL_STATE"] = str(folder / "state")
        (folder / "plate.yaml").write_text(json.dumps(fixture_document(PLATE)))
        here = {
            "robot": ROBOT,
            "fixture_file": str(folder / "plate.yaml"),
            "security_dir": str(security_folder(folder)),
            "port": free_port(),
            "page_port": free_port(),
        }
        started = {}
        for kind in nodes():
            known = {setting.name for setting in kind.SETTINGS}
            for given in GIVEN.get(kind.NAME, ({},)):
                own = {key: value for key, value in (here | given).items() if key in known}
                node = kind(
                    context=context,
                    namespace=NAMESPACE,
                    parameter_overrides=[Parameter(key, value=own[key]) for key in own],
                    use_global_arguments=False,
                    cli_args=["--ros-args", "--params-file", str(CELL / "kr150_shift.yaml")],
                )
                alive.callback(node.close)
                node.autostart()
                if not node.is_active:
                    raise SystemExit(f"{kind.NAME} does not start with {own}")
                started[kind.NAME] = node
        found = {name: {*endpoints(node)} for name, node in started.items()}
    rclpy.shutdown(context=context)
    return found


def options(parser: argparse.ArgumentParser, full: str) -> Iterator[str]:
    """Of a command, and of those below it: names of options and arguments, their choices."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield f"{full} {name}"
                yield from options(below, f"{full} {name}")
            continue
        names = ", ".join(action.option_strings) or f"<{action.metavar or action.dest}>"
        yield f"{full} {names}{one_of(action.choices)}"


def commands(table: Mapping[str, CliCommand | CliGroup], before: str = "robocal") -> Iterator[str]:
    """Each command, and each of its options."""
    for name, command in table.items():
        full = f"{before} {name}"
        yield full
        if isinstance(command, CliGroup):
            yield from commands(command.actions, full)
        else:
            module, place = command.place.split(":")
            parser = CommandParser()
            getattr(import_module(f"robocal_ros.{module}"), f"add_{place}")(parser)
            yield from options(parser, full)


def keys(schema: dict[str, Any], before: str) -> Iterator[str]:
    """Keys of an object and of those within it; what may be missing has a ``?``."""
    needed = {*schema.get("required", ()), *schema.get("else", {}).get("required", ())}
    for name, told in schema.get("properties", {}).items():
        inner, path = told, f"{before}{name}{'' if name in needed else '?'}"
        while isinstance(deeper := inner.get("items", inner.get("additionalProperties")), dict):
            inner, path = deeper, path + ("[]" if "items" in inner else ".*")
        yield path
        yield from keys(inner, f"{path}.")


def documents() -> Iterator[str]:
    """Keys of what ``--json`` prints, and of the parts that documents share."""
    for path in sorted((ROOT / "docs" / "schemas").glob("*.json")):
        schema = json.loads(path.read_text())
        whole = schema if "properties" in schema else schema.get("else", {})
        for name, part in {"": whole, **schema.get("$defs", {})}.items():
            yield from keys(part, f"document {path.stem}{'#' * bool(name)}{name} ")


def definitions() -> Iterator[str]:
    """Fields and constants of messages, services and actions."""
    sections = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
    for path in sorted((ROOT / "msg_defs").glob("*/*.*")):
        kind = path.parent.name
        parts = [f"{kind} {path.stem}"]
        if kind in sections:
            parts = [f"{parts[0]}.{section}" for section in sections[kind]]
        for part, text in zip(parts, path.read_text().split("---\n"), strict=True):
            for line in re.findall(r"^([a-z][^#\n]*)", text, re.M):
                yield f"{part} {line}".rstrip()


def of_plc() -> Iterator[str]:
    """Variables, and arguments of methods, by OPC UA; registers by Modbus TCP."""
    for shown in SHOWN:
        yield from (f"opc_ua {shown.name}.{item.name} {item.kind}" for item in shown.items)
    for method in METHODS:
        for way, items in (("takes", method.inputs), ("answers", method.outputs)):
            yield from (f"opc_ua {method.name} {way} {item.name} {item.kind}" for item in items)
    for table, registers in (("input", INPUTS), ("holding", HOLDINGS)):
        yield from (f"modbus {table} {r.address:02} {r.path} {r.kind}" for r in registers)


def main() -> None:
    """Print them, sorted."""
    found = {*definitions(), *documents(), *commands(COMMANDS), *of_plc()}
    printed = os.dup(1)
    os.dup2(2, 1)  # DDS says there what disturbs it
    on_graph = graph()
    everyone = set.intersection(*on_graph.values())
    found |= {f"every node {line}" for line in everyone}
    for kind in nodes():
        lines = {*parameters(kind)} | on_graph[kind.NAME] - everyone
        found |= {f"{kind.NAME} {line}" for line in lines}
    os.dup2(printed, 1)
    print("\n".join(sorted(found)), flush=True)


if __name__ == "__main__":
    main()
