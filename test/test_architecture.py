# SPDX-License-Identifier: Apache-2.0
"""The house rules that a reader relies on: who may import whom, and how large a file may be."""

import ast
from collections import Counter
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "robocal_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))

GROUND = {"ground", "estimation", "kinematics", "identification", "history", "session"}
MODELS = {"ground", "estimation", "kinematics", "identification"}
BELOW = GROUND | {
    "ros",
    "motion",
    "bags",
    "programs",
}  # the capabilities, which know nothing of each other
CAPABILITIES = {"thermal", "tool", "hand_eye", "correction", "fixture"}
ABOVE = BELOW | CAPABILITIES | {"maintenance"}
# room -> rooms of ours that it may import beside itself
MAY_IMPORT = {
    "ground": set(),
    "estimation": {"ground"},
    "kinematics": {"ground", "estimation"},
    "identification": {"ground", "estimation", "kinematics"},
    "programs": MODELS,
    "history": {"ground", "estimation", "kinematics"},
    "session": {"ground", "estimation", "kinematics", "history"},
    "ros": GROUND,
    "motion": GROUND | {"ros"},
    "bags": GROUND | {"ros", "motion"},
    "adapter": {"ground", "ros"},
    "plc": {"ground", "ros", "adapter"},
    "panel": {"ground", "ros", "history", "plc"},
    **dict.fromkeys(CAPABILITIES, BELOW),
    "maintenance": BELOW | CAPABILITIES,
    "report": ABOVE,
    "cell_sim": ABOVE | {"report"},
    "cli": ABOVE | {"report", "cell_sim"},
}
COMMANDS = {"cli", "cli_sensors"}  # files of a room
ROS_FILES = {
    "node", "messages", "action", "settings", "services", "report",
    "graph", "driver", "replay_node", "recorder_node", "sharing_node",
}  # fmt: skip
ROS = {
    "rclpy", "robocal_msgs", "sensor_msgs", "geometry_msgs", "std_msgs", "std_srvs",
    "trajectory_msgs", "control_msgs", "action_msgs", "builtin_interfaces", "lifecycle_msgs",
}  # fmt: skip
LONGEST_FILE = 700
LONGEST_FUNCTION = 60  # without its docstring


@cache
def written(path: Path) -> tuple[set[str], list[ast.ImportFrom], list[str], dict[str, int]]:
    """Names that a file imports anywhere, its imports and classes at the top, and how many lines
    each of its functions has without its docstring; it is parsed once.
    """
    names, functions, tree = set(), {}, ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node, clean=False) or ""
            lines = node.end_lineno - node.lineno + 1 - len(docstring.splitlines())
            functions[f"{node.name}, line {node.lineno}"] = lines
    top = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    return names, top, classes, functions


def room(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def imports_of_ours(path: Path) -> set[Path]:
    """Files of the package that a file needs when it is imported."""
    found = set()
    for node in written(path)[1]:
        if (node.module or "").startswith("robocal_ros"):
            base = PACKAGE.parent.joinpath(*(node.module or "").split("."))
            files = [base / f"{alias.name}.py" for alias in node.names]
            found |= {file if file.exists() else base.with_suffix(".py") for file in files}
    return {file for file in found if file.exists()}


def wrong_imports(path: Path) -> list[str]:
    own, wrong = room(path), []
    for_ros = own == "ros" or path.stem in ROS_FILES
    for name in written(path)[0]:
        parts = name.split(".")
        if parts[0] in ROS and not for_ros:
            wrong.append(f"{path} imports {name}: only what a node is made of may")
        if parts[0] == "robocal_ros" and len(parts) > 1 and own:
            allowed = MAY_IMPORT[own] | {own}
            # A room's commands; the command line loads them by name, and nobody else.
            if path.stem in COMMANDS:
                allowed |= {"cli", "report"}
            elif own in CAPABILITIES and parts[2:3] and parts[2] in COMMANDS:
                wrong.append(f"{path} imports {name}")
            if parts[1] not in allowed:
                wrong.append(f"{own} imports {name}, in {path}")
    return wrong


def test_imports_run_one_way():
    wrong = [words for path in MODULES for words in wrong_imports(path)]
    assert not wrong, "\n".join(wrong)


def test_the_rules_name_files_that_are_there():
    assert {path.stem for path in MODULES} >= ROS_FILES | COMMANDS


def test_no_file_needs_itself():
    needs = {path: imports_of_ours(path) for path in MODULES}
    done: set[Path] = set()

    def walk(path: Path, way: tuple[Path, ...]) -> None:
        assert path not in way, f"a circle: {[p.stem for p in way[way.index(path) :]]}"
        if path not in done:
            for needed in needs[path]:
                walk(needed, (*way, path))
            done.add(path)

    for path in MODULES:
        walk(path, ())


def test_our_modules_keep_their_names():
    renamed = [
        f"{path}: {alias.name} as {alias.asname}"
        for path in MODULES
        for node in written(path)[1]
        for alias in node.names
        if alias.asname
        and PACKAGE.parent.joinpath(*node.module.split("."), f"{alias.name}.py").exists()
    ]
    assert not renamed, "\n".join(renamed)


def test_files_and_functions_stay_small():
    large = []
    for path in MODULES:
        lines = len(path.read_text().splitlines())
        large += [f"{path} has {lines} lines"] * (lines > LONGEST_FILE)
        for name, body in written(path)[3].items():
            large += [f"{path}: {name}, has {body} lines"] * (body > LONGEST_FUNCTION)
    assert not large, "\n".join(large)


def test_a_class_name_occurs_once():
    seen: dict[str, Path] = {}
    twice = []
    for path in MODULES:
        for name in written(path)[2]:
            if name in seen:
                twice.append(f"{name}: {seen[name]} and {path}")
            seen[name] = path
    assert not twice, "\n".join(twice)


def bound(path: Path) -> list[str]:
    """Names that a file binds at its top, each as often as it does."""
    names: list[str] = []
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.append(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            names += [alias.asname or alias.name for alias in node.names]
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names += [
                each.id
                for target in targets
                for each in ast.walk(target)
                if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
            ]
    return names


def test_no_constant_takes_the_name_of_another():
    twice = {
        (path.stem, name) for path in MODULES for name, n in Counter(bound(path)).items() if n > 1
    }
    assert not twice
