"""The house rules that a reader relies on: who may import whom, and how large a room may be.

`correction` and `motion` are rooms of the new house, one for each capability; the others are still
layers.
"""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "robocal_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))

# room -> rooms of ours that it may import
MAY_IMPORT = {
    "core": {"core"},
    "motion": {"core", "motion"},
    "correction": {"core", "motion", "correction"},
    "sessions": {"core", "motion", "correction", "sessions"},  # maintenance asks the capabilities
    "storage": {"core", "storage"},
    "sim": {"core", "motion", "sim"},
    "report": {"core", "report"},
    "cli": {"core", "motion", "correction", "sessions", "storage", "sim", "report", "cli"},
    "nodes": {
        "core", "motion", "correction", "sessions", "storage", "sim", "report", "nodes",
    },
}  # fmt: skip
ROOMS = {"correction", "motion"}  # each with its own files for ROS, which are nodes as well
ROS_FILES = {
    "node", "messages", "action", "settings", "report", "graph", "driver", "topics", "log",
    "command_sources", "health", "settled_streams", "stream_messages", "path_messages",
    "gap_sources",
}  # fmt: skip
ROS = {
    "rclpy", "robocal_msgs", "sensor_msgs", "geometry_msgs", "std_msgs", "std_srvs",
    "trajectory_msgs", "control_msgs",
}  # fmt: skip
LONGEST_MODULE = {False: 300, True: 700}  # in a layer, in a room
LONGEST_FUNCTION = {False: 40, True: 60}  # without its docstring


def imported(tree: ast.AST) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    own = room(path)
    for_ros = own == "nodes" or (own in ROOMS and path.stem in ROS_FILES)
    allowed = MAY_IMPORT.get(own, set()) | {"single_thread"}
    if for_ros:
        allowed |= MAY_IMPORT["nodes"]
    for name in imported(ast.parse(path.read_text())):
        parts = name.split(".")
        if parts[0] in ROS:
            assert for_ros, f"{path} imports {name}: only what a node is made of may"
        if parts[0] == "robocal_ros" and len(parts) > 1 and own in MAY_IMPORT:
            assert parts[1] in allowed, f"{own} imports {name}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_rooms_stay_small(path):
    text, in_room = path.read_text(), room(path) in ROOMS
    assert len(text.splitlines()) <= LONGEST_MODULE[in_room]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node, clean=False) or ""
            body = node.end_lineno - node.lineno + 1 - len(docstring.splitlines())
            assert body <= LONGEST_FUNCTION[in_room], f"{path.name}: {node.name} has {body} lines"


def test_a_class_name_occurs_once_in_the_rooms():
    seen: dict[str, Path] = {}
    for path in MODULES:
        if room(path) in ROOMS:
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef):
                    assert node.name not in seen, f"{node.name}: {seen[node.name]} and {path}"
                    seen[node.name] = path
