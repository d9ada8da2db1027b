# SPDX-License-Identifier: Apache-2.0
"""What of ours others rely on by name, as one JSON document, to be compared with diff.

    tools/with_ros python tools/public_names.py >names.json

Executables; parameters with default and bounds; private topics, services and actions whose names
stand whole in the code; message definitions; help of all commands; JSON schemas; codes. Not seen
are names that are put together (the Trigger twins), relative inputs and launch arguments. It reads
the tree in the working directory, so that one file serves to compare two commits.
"""

import ast
import hashlib
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path.cwd()
sys.path.insert(0, str(ROOT))


def executables() -> dict[str, str]:
    """Console scripts and the modules behind them."""
    lines = re.findall(r'"(\w+) = ([\w.]+):main"', (ROOT / "setup.py").read_text())
    return dict(lines)


def parameters(module: str) -> dict[str, Any]:
    """What a node's table declares."""
    base = sys.modules[next(name for name in sys.modules if re.search(r"robocal.*\.base$", name)
                            and hasattr(sys.modules[name], "HouseNode"))]  # fmt: skip
    found = {}
    for node in vars(importlib.import_module(module)).values():
        if isinstance(node, type) and issubclass(node, base.HouseNode) and hasattr(node, "NAME"):
            for setting in (base.AUTOSTART, base.SERIAL, *node.SETTINGS):
                limits = [setting.low, setting.high, list(setting.choices), setting.live]
                found[setting.name] = [setting.default, setting.unit, *limits]
    return found


def endpoints() -> list[str]:
    """Names of private topics, services and actions that stand whole in the code."""
    found = set()
    for file in (ROOT / "robocal_ros").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found |= set(re.findall(r"^~/[\w/]+$", node.value))
    return sorted(found)


def command_help(*words: str) -> dict[str, str]:
    """Help of a command and of those below it."""
    done = subprocess.run(
        [sys.executable, "-m", "robocal_ros.cli.main", *words, "--help"],
        capture_output=True, text=True, check=True, env={"COLUMNS": "100", "PATH": ""},
    )  # fmt: skip
    found = {" ".join(("robocal", *words)): done.stdout}
    if re.search(r"^  (command|action)$", done.stdout, re.M):
        for name in re.findall(r"^    ([a-z][\w-]*) ", done.stdout, re.M):
            found |= command_help(*words, name)
    return found


def files(folder: str, *kinds: str) -> dict[str, str]:
    """Digest of each file."""
    return {
        str(path.relative_to(ROOT)): hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        for kind in kinds
        for path in sorted((ROOT / folder).rglob(kind))
    }


def main() -> None:
    """Print them."""
    scripts = executables()
    modules = {name: importlib.import_module(place) for name, place in scripts.items()}
    codes = importlib.import_module("robocal_ros.ground.errors" if (
        ROOT / "robocal_ros/ground").is_dir() else "robocal_ros.core.codes")  # fmt: skip
    names = {
        "executables": sorted(scripts),
        "parameters": {
            name: parameters(module.__name__)
            for name, module in modules.items()
            if name.endswith("_node")
        },
        "private names": endpoints(),
        "definitions": files("msg_defs", "*.msg", "*.srv", "*.action"),
        "schemas": files("docs/schemas", "*.json"),
        "codes": {code.name: int(code) for code in codes.Code},
        "help": command_help(),
    }
    print(json.dumps(names, indent=1))


if __name__ == "__main__":
    main()
