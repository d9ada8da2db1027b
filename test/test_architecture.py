"""The house rules that a reader relies on: who may import whom, and how large a room may be."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "robocal_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))

# room -> rooms of ours that it may import
MAY_IMPORT = {
    "core": {"core"},
    "sessions": {"core", "sessions"},
    "storage": {"core", "storage"},
    "sim": {"core", "sim"},
    "report": {"core", "report"},
    "cli": {"core", "sessions", "storage", "sim", "report", "cli"},
    "nodes": {"core", "sessions", "storage", "sim", "report", "nodes"},
}
ROS = {"rclpy", "robocal_msgs", "sensor_msgs", "geometry_msgs", "std_msgs", "std_srvs"}
LONGEST_MODULE = 300
LONGEST_FUNCTION = 40  # without its docstring


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
    for name in imported(ast.parse(path.read_text())):
        parts = name.split(".")
        if parts[0] in ROS:
            assert own == "nodes", f"{path} imports {name}: only nodes/ may"
        if parts[0] == "robocal_ros" and len(parts) > 1 and own in MAY_IMPORT:
            assert parts[1] in MAY_IMPORT[own] | {"single_thread"}, f"{own} imports {name}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_rooms_stay_small(path):
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST_MODULE
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node, clean=False) or ""
            body = node.end_lineno - node.lineno + 1 - len(docstring.splitlines())
            assert body <= LONGEST_FUNCTION, f"{path.name}: {node.name} has {body} lines"
