# SPDX-License-Identifier: Apache-2.0
"""Run the real ``robocal`` in a process of its own, and check what it prints."""

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from forked import HANGS_S, become, forks
from jsonschema import Draft202012Validator

from robocal_ros.bags.replay import NOT_BITS

ROOT = Path(__file__).parents[2]
SCHEMAS = {path.name: json.loads(path.read_text()) for path in (ROOT / "docs/schemas").glob("*")}
COMMAND = [sys.executable, "-m", "robocal_ros.cli.main"]


def environment(**variables: str) -> dict[str, str]:
    given = ("ROBOCAL_STATE", "COLUMNS")  # by whoever runs the tests
    plain = {name: value for name, value in os.environ.items() if name not in given}
    return plain | {"PYTHONPATH": f"{ROOT}:{plain.get('PYTHONPATH', '')}"} | variables


def robocal(*arguments: object, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run it; nothing is checked.

    It is forked from a process that has read the code, which saves a second of processor time;
    ``validate`` has such forks of its own, and begins as a user's does.
    """
    words, given = [str(argument) for argument in arguments], environment(**variables)
    if words[:1] == ["validate"]:
        return subprocess.run(
            [*COMMAND, *words],
            capture_output=True,
            text=True,
            timeout=HANGS_S,
            env=given,
            check=False,
        )
    with tempfile.TemporaryDirectory() as folder:
        said = [Path(folder) / name for name in ("stdout", "stderr")]
        process = forks().Process(target=_as_command, args=(words, given, Path.cwd(), said))
        process.start()
        process.join(HANGS_S)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(words, HANGS_S)
        return subprocess.CompletedProcess(
            words, process.exitcode, *(file.read_text(encoding="utf-8") for file in said)
        )


def _as_command(words: list[str], given: dict[str, str], folder: Path, said: list[Path]) -> None:
    become(given, folder, said)
    sys.argv = ["robocal", *words]
    from robocal_ros.cli.main import main

    sys.exit(main())


def _bundled(name: str, part: Any) -> Any:
    """A schema with its references made local to one that holds them all."""
    if isinstance(part, list):
        return [_bundled(name, one) for one in part]
    if not isinstance(part, dict):
        return part
    bundled = {key: _bundled(name, one) for key, one in part.items() if key != "$id"}
    if isinstance(part.get("$ref"), str):
        file, _, place = part["$ref"].partition("#")
        bundled["$ref"] = f"#/$defs/{file or name}{place}"
    return bundled


BUNDLE = {name: _bundled(name, schema) for name, schema in SCHEMAS.items()}


def conforms(document: Any, schema: str) -> None:
    """Fail unless the document follows a schema of docs/schemas."""
    Draft202012Validator({"$ref": f"#/$defs/{schema}", "$defs": BUNDLE}).validate(document)


def robocal_json(schema: str, *arguments: object, status: int = 0, **variables: str) -> Any:
    """Run it with ``--json``: exit status, exactly one document, and its schema are checked."""
    done = robocal(*arguments, "--json", **variables)
    assert done.returncode == status, done.stderr
    document = json.loads(done.stdout)
    conforms(document, schema)
    if status:
        conforms(document, "error.json")
        assert "Traceback" not in done.stderr
    return document


def takes(command: str) -> None:
    """Fail unless the command line is one: words in capitals stand for files and names."""
    from robocal_ros.cli import main
    from robocal_ros.cli.commands import COMMANDS

    words = shlex.split(command)
    if words[0] == "robocal":
        parser = main.CommandParser(prog="robocal")
        numbers = {"UP": "400", "DOWN": "360", "RADIUS": "20"}
        arguments = [numbers.get(word, word) for word in words[1:]]
        named = [word for word in arguments if not word.startswith("-")]
        main._declare(parser, "command", COMMANDS, named)
        assert isinstance(parser.parse_args(arguments), argparse.Namespace)
    else:
        assert words[:3] in (["ros2", "launch", "robocal_ros"], ["ros2", "run", "robocal_ros"])


def beyond_rounding(replayed: Mapping[str, Any]) -> list[str]:
    """What of a kept bag's replay differs by more than how its maker's processor rounds."""
    return [words for words in replayed["differs"] if NOT_BITS not in words]
