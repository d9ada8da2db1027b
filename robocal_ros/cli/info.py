# SPDX-License-Identifier: Apache-2.0
"""``robocal info FILE``: what a bag, table or file holds, and what can be done with it."""

import argparse
import shlex
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from robocal_ros.cli.main import CliResult, Document, describe_robot, print_table, print_words
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.files import read_bytes

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.cli.documents import BagTopicDocument, InfoDocument

Facts = list[tuple[str, str]]
Told = tuple[str, Facts, list[str]]  # what it is, facts of it, commands that take it
BAGS = (".mcap", ".db3", ".bag")
SQLITE = b"SQLite format 3\0"


def add_info(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="file, or folder of a bag")


def run_info(args: argparse.Namespace) -> CliResult:
    path: Path = args.file
    topics: list[BagTopicDocument] = []
    if path.is_dir() or path.suffix in BAGS:
        kind, facts, commands, topics = _bag(path)
    else:
        kind, facts, commands = _file(path)
    document: InfoDocument = {
        "file": str(path),
        "kind": kind,
        "facts": [{"name": name, "value": value} for name, value in facts],
        "topics": topics,
        "commands": commands,
    }
    return CliResult(document, _show)


def _show(console: "Console", document: Document) -> None:
    print_words(console, f"{document['file']}: {document['kind']}", "bold")
    for fact in document["facts"]:
        print_words(console, f"  {fact['name']}: {fact['value']}")
    if document["topics"]:
        rows = [[one["topic"], one["type"], str(one["messages"])] for one in document["topics"]]
        print_table(console, "", ("topic", "type", "messages"), rows, words=(0, 1))
    if document["commands"]:
        print_words(console, "What can be done with it:")
    for command in document["commands"]:
        print_words(console, f"  {command}")


# ---- bags ---------------------------------------------------------------------------------------


def _typed(name: Path | str) -> str:
    """As a shell takes it, spaces and all."""
    return shlex.quote(str(name))


def _bag(path: Path) -> tuple[str, Facts, list[str], "list[BagTopicDocument]"]:
    from robocal_ros.bags.bags import open_bag
    from robocal_ros.bags.replay import EVENTS, first_configuration
    from robocal_ros.cli.recording import event_topics, is_simulated
    from robocal_ros.session.events import session_kind

    with open_bag(path) as reader:
        info = reader.info
        start_ns, end_ns = info.start_ns or 0, info.end_ns or 0
        begin = datetime.fromtimestamp(start_ns * 1e-9, UTC)
        facts = [
            ("from", f"{begin:%Y-%m-%d %H:%M:%S} UTC, {(end_ns - start_ns) * 1e-9:.1f} s"),
            ("messages", str(info.messages)),
            *(("damage", note) for note in info.notes),
        ]
        if is_simulated(reader):
            facts.append(("truth", "tells what is true: the bag is simulated"))
        sessions = {}
        for topic in event_topics(info):
            configured = first_configuration(reader.messages([topic]))
            if configured is not None and (kind := session_kind(configured)):
                sessions[topic] = kind
                robot = configured.arguments.get("robot", "")
                facts.append(("session", f"{kind} of {robot}, told on {topic}"))
    named = {topic.rpartition("/")[2]: topic for topic in info.topics}
    if sessions:
        commands = [f"robocal validate {_typed(path)} --report out/validation"]
        one = len(sessions) == 1
        commands += [
            f"robocal replay {_typed(path)}" + ("" if one else f" --topic {EVENTS}:={topic}")
            for topic in sessions
        ]
    elif "joint_states" in named:
        facts.append(("session", "none: commands of a node were not recorded"))
        commands = [f"robocal replay {_typed(path)} --robot ROBOT --auto"]
        commands += [f"robocal replay {_typed(path)} --robot ROBOT --auto --topic INPUT:=TOPIC"]
    else:
        facts.append(("session", "none, and no joint_states: there is nothing to replay"))
        commands = []
    topics: list[BagTopicDocument] = [
        {"topic": topic, "type": held.msgtype, "messages": held.messages}
        for topic, held in info.topics.items()
    ]
    return "bag", facts, commands, topics


# ---- files --------------------------------------------------------------------------------------


def _file(path: Path) -> Told:
    from robocal_ros.programs.correcting import DIALECTS

    data = read_bytes(path, "file")
    if data.startswith(SQLITE):
        return _history(path)
    text = data.decode(errors="replace")  # programs of controllers may be in other encodings
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _table(path)
    if suffix in (".yaml", ".yml", ".json"):
        return _mapping(path, text)
    if suffix in (".urdf", ".xacro", ".xml") or "<robot" in text[:2000]:
        return _description(path, text)
    if suffix == ".conf" or "delta_theta" in text:
        command = f"robocal import-ur --calibration {_typed(path)} --nominal urcontrol.conf"
        command += " --output robot.yaml"
        return "calibration of a Universal Robots controller", [], [command]
    for dialect in DIALECTS:
        if suffix in dialect.suffixes:
            command = (
                f"robocal correct-program {_typed(path)} --robot ROBOT --model MODEL --output FILE"
            )
            lines = ("lines", str(text.count("\n")))
            return f"program of {dialect.maker}", [lines], [f"{command}{path.suffix}"]
    known = "a bag, a table (.csv), a robot or result file (.yaml, .json), a URDF, a program"
    raise InputError(f"is of no kind that is known: {known}, or a history", file=str(path))


def _history(path: Path) -> Told:
    from robocal_ros.history.calibrations import CalibrationHistory
    from robocal_ros.history.history_records import THERMAL

    serial, folder = unquote(path.stem), path.absolute().parent
    with CalibrationHistory.open(serial, state_dir=folder, create=False, owner=False) as history:
        heads = history.heads()
        facts = [("calibrations", str(len(history.list(1_000_000))))]
        facts += [(f"{head.kind} in force", f"revision {head.revision}") for head in heads]
    of = f"--state {_typed(path.parent)} --robot-serial {_typed(serial)}"
    commands = [f"robocal history list {of}", f"robocal history corrections {of}"]
    newest = {head.calibration_id: head.kind for head in heads if head.calibration_id}
    for number, kind in newest.items():
        commands += [
            f"robocal history show {number} {of} --json",
            f"robocal history rollback --kind {_typed(kind)} {of}",
        ]
        if kind == THERMAL:
            commands.append(
                f"robocal correct-program PROGRAM.src --robot ROBOT {of} --output CORRECTED.src"
            )
    return f"history of the robot with serial {serial}", facts, commands


def _table(path: Path) -> Told:
    from robocal_ros.kinematics.tables import read_cells

    cells = read_cells(path, lambda header, file: None)
    columns = set(cells.columns)
    facts = [("rows", str(len(cells.rows))), ("columns", ", ".join(cells.columns))]
    joints = [name for name in cells.columns if name[:1] == "q" and name[1:2].isdigit()]
    place = bool({"x_mm", "x_m"} & columns)
    turned = bool({"rx_deg", "rvx_rad", "qx", "w_deg"} & columns)
    if {"stamp_s", "beam", "blocked"} <= columns:
        return "table of beam edges", facts, [
            f"robocal tool crossed --events {_typed(path)} --joints JOINTS.csv --robot ROBOT "
            "--laser L.yaml"
        ]  # fmt: skip
    if {"sweep", "beam"} <= columns:
        return "table of sweeps through parallel beams", facts, [
            f"robocal tool parallel --data {_typed(path)} --up-mm UP --down-mm DOWN"
        ]  # fmt: skip
    if "point" in columns and place:
        beams = [f"robocal tool beams --data {_typed(path)}"]
        return "table of the edges that place beams", facts, beams
    if joints and place:
        facts.append(("joints", str(len(joints))))
        commands = [f"robocal identify --robot ROBOT --data {_typed(path)} --hold-out 0.5"]
        if {"pose", "cycle"} <= columns:
            commands.append(
                "robocal thermal identify --robot ROBOT --sensor S.yaml --cold COLD.csv "
                f"--warm {_typed(path)}"
            )
        return "measurements: joints, and where a target was", facts, commands
    if joints:
        facts.append(("joints", str(len(joints))))
        kind = "joint readings over time" if "stamp_s" in columns else "poses, as joints"
        return f"table of {kind}", facts, []
    if place and turned:
        return "table of flange poses", facts, [f"robocal tool points --data {_typed(path)}"]
    return "table of no kind that is known (docs/files.md has the columns)", facts, []


def _mapping(path: Path, text: str) -> Told:
    from robocal_ros.kinematics.robots import load_yaml

    found: Any = load_yaml(text, str(path))
    keys = set(found) if isinstance(found, Mapping) else set()
    for needed, told in KINDS:
        if keys >= needed:
            return told(path, found)
    parts = found.values() if keys else ()
    if any(isinstance(part, Mapping) and "ros__parameters" in part for part in parts):
        nodes = [("nodes", ", ".join(map(str, found)))]
        return "parameter file of nodes", nodes, [
            f"ros2 launch robocal_ros cell.launch.py params:={_typed(path)}"
        ]  # fmt: skip
    words = ", ".join(map(str, found)) if keys else type(found).__name__
    return "document of no kind that is known", [("holds", words)], []


def _robot(path: Path, _: Any) -> Told:
    try:
        description, notes = describe_robot(str(path))
    except RobocalError as error:
        return "robot file that is not valid", [("fault", str(error))], []
    arm = description.arm
    facts = [
        ("robot", f"{arm.name}, {arm.n} joints: {', '.join(arm.joint_names)}"),
        ("model hash", arm.model_hash),
        ("joint functions", "yes" if arm.functions is not None else "none"),
        *(("open", note) for note in notes),
    ]
    zeros = ",".join(["0"] * arm.n)
    return "robot file", facts, [
        f"robocal fk --robot {_typed(path)} --joints-deg {zeros}",
        f"robocal identify --robot {_typed(path)} --data MEASURED.csv",
        f"robocal export-urdf --robot {_typed(path)} --output robot.urdf",
    ]  # fmt: skip


def _laser(path: Path, found: Any) -> Told:
    names = ("station", "robot", "model_hash", "serial")
    facts = [(name, str(found[name])) for name in names if name in found]
    return "laser file: beams of a station", facts, [
        f"robocal tool crossed --laser {_typed(path)} --events EDGES.csv --joints JOINTS.csv "
        "--robot ROBOT",
        f"ros2 run robocal_ros tcf_node --ros-args -p laser:={_typed(path)} -p robot:=ROBOT",
    ]  # fmt: skip


def _kinematics(path: Path, found: Any) -> Told:
    held = found["kinematics"]
    facts = [("hash", str(held.get("hash", "none")))] if isinstance(held, Mapping) else []
    words = "kinematics of a Universal Robots arm, as ur_calibration writes them"
    return words, facts, [f"robocal import-urdf {_typed(path)} --output robot.yaml"]


def _result(path: Path, found: Any) -> Told:
    """A command's document, or one with a ``document`` and a ``model`` as the history shows it."""
    shown = found.get("document")
    held = shown if isinstance(shown, Mapping) else found
    verdict = held.get("verdict", "none")
    if isinstance(verdict, Mapping):
        verdict = f"{verdict.get('code')}: {verdict.get('reason')}"
    file = _typed(path)
    commands = []
    for parent, frame in (("flange", "tool0"), ("base", "base")):
        if held.get(f"T_{parent}_sensor") is not None:
            commands.append(
                f"robocal hand-eye export --result {file} --format urdf --parent {frame} "
                "--child SENSOR"
            )
    if held.get("T_flange_sensor") is not None:
        commands.append(
            f"robocal hand-eye verify --result {file} --target-kind sphere --radius-mm RADIUS "
            "--poses POSES.csv --profiles PROFILES"
        )
    if held.get("tcp_mm") is not None:
        commands.append(f"robocal tool export --tool {file} --format kuka")
    model = found.get("model")
    if path.suffix == ".json" and isinstance(model, Mapping) and "joint_names" in model:
        commands.append(
            f"robocal correct-program PROGRAM.src --robot ROBOT --model {file} "
            "--output CORRECTED.src"
        )
    what = "calibration of a history" if held is shown else "result of a robocal command"
    return what, [("verdict", str(verdict))], commands


KINDS: tuple[tuple[set[str], Callable[[Path, Any], Told]], ...] = (
    ({"convention", "joints"}, _robot),
    ({"points_mm", "reach_mm"}, _laser),
    ({"kinematics"}, _kinematics),
    ({"calibration", "document", "inputs"}, _result),
    ({"verdict"}, _result),
)
"""Keys that a kind of document has, and what is told of it."""


def _description(path: Path, text: str) -> Told:
    from robocal_ros.kinematics.urdf import chain, read_urdf

    try:
        links = chain(read_urdf(text, str(path)))
    except RobocalError as error:
        return "description of a robot that gives no arm", [("fault", str(error))], []
    facts = [
        ("arm", f"{links.base} to {links.tip}, {len(links.moving)} joints"),
        ("joints", ", ".join(joint.name for joint in links.moving)),
    ]
    return "description of a robot (URDF)", facts, [
        f"robocal import-urdf {_typed(path)} --output robot.yaml",
        f"robocal export-urdf --robot MODEL.yaml --into {_typed(path)} --output calibrated.urdf",
    ]  # fmt: skip
