# SPDX-License-Identifier: Apache-2.0
import io
import json
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Literal, NotRequired, TypedDict

import pytest
from command import COMMAND, ROOT, SCHEMAS, conforms, environment, robocal, robocal_json
from jsonschema import Draft202012Validator

from robocal_ros import __version__
from robocal_ros.cli import main as frame
from robocal_ros.cli.main import CliResult, exit_status, failure
from robocal_ros.ground.documents import Three, keywords
from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    RankDeficientError,
    RobocalError,
    StorageError,
    TooFewSamplesError,
    WrongRobotError,
)


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_schemas_are_schemas(name):
    Draft202012Validator.check_schema(SCHEMAS[name])
    assert SCHEMAS[name]["$id"] == name


def test_the_schemas_are_made_from_the_declarations():
    made = runpy.run_path(str(ROOT / "tools" / "schemas.py"))["all_schemas"]()
    kept = {path.name: path.read_text() for path in (ROOT / "docs" / "schemas").iterdir()}
    assert made == kept, "run tools/schemas.py"


class Part(TypedDict):
    share: Annotated[float, keywords(minimum=0, maximum=1), "Of all."]
    way: NotRequired[Literal["up", "down"]]


class Whole(TypedDict):
    parts: Annotated[dict[str, Part | None], keywords(minProperties=1)]
    place: Three | None


@pytest.mark.parametrize(
    ("change", "fits"),
    [
        ({}, True),
        ({"place": None}, True),
        ({"place": [1, 2]}, False),
        ({"place": [1, 2, "3"]}, False),
        ({"parts": {}}, False),
        ({"parts": {"a": None}}, True),
        ({"parts": {"a": {"share": 1.1}}}, False),
        ({"parts": {"a": {"share": 1, "way": "left"}}}, False),
        ({"parts": {"a": {"way": "up"}}}, False),
        ({"more": 1}, False),
    ],
)
def test_a_schema_holds_what_its_declaration_says(change, fits):
    schema = runpy.run_path(str(ROOT / "tools" / "schemas.py"))["Schemas"]({}).of(Whole)
    document = {"parts": {"a": {"share": 0.5, "way": "up"}}, "place": [1, 2, 3]} | change
    assert Draft202012Validator(schema).is_valid(document) is fits
    words = schema["properties"]["parts"]["additionalProperties"]["properties"]["share"]
    assert words["description"] == "Of all."


class TestUsage:
    @pytest.mark.parametrize(
        "arguments",
        [
            (),
            ("no-such-command",),
            ("--no-such-option",),
            ("history",),
            ("history", "no-such-action"),
            ("history", "accept"),
            ("history", "accept", "x"),
            ("history", "list", "--limit", "0"),
            ("history", "list", "--lim", "3"),  # no abbreviations
            ("history", "rollback", "--to", "-1"),
        ],
    )
    def test_wrong_usage(self, arguments):
        plain = robocal(*arguments)
        assert plain.returncode == 2
        assert plain.stdout == ""
        assert "usage: robocal" in plain.stderr
        assert "[BAD_INPUT]" in plain.stderr
        for place in range(len(arguments) + 1):
            done = robocal(*arguments[:place], "--json", *arguments[place:])
            assert done.returncode == 2
            document = json.loads(done.stdout)
            conforms(document, "error.json")
            assert document["error"]["code"] == "BAD_INPUT"
            assert document["error"]["message"] in plain.stderr or place < len(arguments)

    @pytest.mark.parametrize(
        ("arguments", "meant"),
        [
            ("identfy", "identify"),
            ("tool crosed", "crossed"),
            ("identify --hold-ot 0.5 --robot ur10 --data x.csv", "--hold-out"),
            ("identify --rbot=ur10 --data x.csv", "--robot"),
        ],
    )
    def test_what_was_meant_is_named(self, arguments, meant):
        assert f"(did you mean '{meant}'?)" in robocal(*arguments.split()).stderr

    def test_what_is_like_nothing_is_not_guessed(self):
        assert "did you mean" not in robocal("zzzz").stderr

    def test_help_and_version(self):
        done = robocal("--version")
        assert (done.returncode, done.stdout) == (0, f"robocal {__version__}\n")
        done = robocal("--help")
        assert done.returncode == 0
        for name in frame.COMMANDS:
            assert f"\n    {name}" in done.stdout
        assert "bring a pending" in robocal("history", "accept", "--help").stdout

    @pytest.mark.parametrize(
        "command", [(), *((name,) for name in frame.COMMANDS), ("history", "accept")], ids=" ".join
    )
    def test_help_as_json_is_one_document(self, command):
        document = robocal_json("information.json", *command, "--help")
        assert document == {"help": robocal(*command, "--help").stdout.rstrip("\n") + "\n"}
        assert document["help"].startswith(" ".join(("usage: robocal", *command)))
        assert "--json" in document["help"] or not command
        if not command or command == ("history", "accept"):
            assert robocal_json("information.json", "--json", *command, "-h") == document

    def test_version_as_json_is_one_document(self):
        document = robocal_json("information.json", "--version")
        assert document == {"version": f"robocal {__version__}"}


class TestStart:
    def test_help_loads_nothing_heavy(self):
        heavy = "import sys; from robocal_ros.cli.main import main; main(['--help']); print(sorted("
        heavy += "{'numpy', 'scipy', 'rich', 'rclpy', 'numba'} & set(sys.modules)))"
        done = subprocess.run(
            [sys.executable, "-c", heavy], check=True, capture_output=True, env=environment()
        )
        assert done.stdout.endswith(b"\n[]\n")

    def test_one_blas_thread(self):
        code = (
            "import os, robocal_ros.cli.main; import numpy; print("
            "os.environ['OPENBLAS_NUM_THREADS'], os.environ['OMP_NUM_THREADS'], "
            "os.environ['MKL_NUM_THREADS'], len(os.listdir('/proc/self/task')))"
        )
        done = subprocess.run(
            [sys.executable, "-c", code],
            check=True,
            capture_output=True,
            env=environment(OPENBLAS_NUM_THREADS="4"),
        )
        assert done.stdout == b"1 1 1 1\n"

    def test_installed_command(self):
        from importlib.metadata import entry_points

        found = [point for point in entry_points(group="console_scripts", name="robocal")]
        for point in found:
            assert point.value == "robocal_ros.cli.main:main"


def with_command(monkeypatch, run):
    """A frame whose only command is this function."""
    module = SimpleNamespace(add_probe=lambda parser: None, run_probe=run)
    command = frame.CliCommand("test:probe", "made for a test")
    monkeypatch.setattr(frame, "COMMANDS", {"probe": command})
    monkeypatch.setattr(frame, "import_module", lambda name: module)


def fails_with(monkeypatch, capsys, error, *arguments):
    def run(args):
        raise error

    with_command(monkeypatch, run)
    status = frame.main(["probe", *arguments])
    out, err = capsys.readouterr()
    return status, out, err


class TestOutcomes:
    @pytest.mark.parametrize(
        ("error", "status"),
        [
            (InputError("no number", file="a.csv", row=3, column="q1_deg"), 2),
            (StorageError("disk full"), 2),
            (WrongRobotError("another robot"), 2),
            (TooFewSamplesError("3 of 20"), 3),
            (RankDeficientError("one direction", ["d6 with a6"]), 3),
            (ConflictError("too late"), 3),
        ],
    )
    def test_errors(self, monkeypatch, capsys, error, status):
        assert fails_with(monkeypatch, capsys, error, "--json")[0] == status
        found, out, err = fails_with(monkeypatch, capsys, error, "--json")
        document = json.loads(out)
        conforms(document, "error.json")
        assert found == status
        assert document["error"]["code"] == document["verdict"]["code"] == error.code.name
        assert document["error"]["row"] == getattr(error, "row", None)
        assert document["error"]["file"] == getattr(error, "file", None)
        assert document.get("unobservable", []) == list(getattr(error, "directions", []))
        assert str(error) in err
        assert "Traceback" not in err
        assert fails_with(monkeypatch, capsys, error)[:2] == (status, "")

    def test_every_code_has_a_status(self):
        for code in set(Code) - {Code.ACCEPT}:
            error = RobocalError("x")
            error.code = code
            assert exit_status(error.code) in (2, 3)
            conforms(failure(error), "error.json")

    def test_missing_file_is_no_crash(self, monkeypatch, capsys):
        error = FileNotFoundError(2, "No such file or directory", "bag.mcap")
        status, out, _ = fails_with(monkeypatch, capsys, error, "--json")
        assert status == 2
        assert json.loads(out)["error"]["file"] == "bag.mcap"

    def test_crash(self, monkeypatch, capsys):
        status, out, err = fails_with(monkeypatch, capsys, ZeroDivisionError("oh"), "--json")
        assert status == 1
        conforms(json.loads(out), "error.json")
        assert "Traceback" in err
        status, out, err = fails_with(monkeypatch, capsys, ZeroDivisionError("oh"))
        assert (status, out) == (1, "")
        assert "ZeroDivisionError: oh" in err

    def test_nan_never_leaves(self, monkeypatch, capsys):
        with_command(
            monkeypatch, lambda args: CliResult({"x": float("nan")}, lambda console, document: None)
        )
        assert frame.main(["probe", "--json"]) == 1
        assert json.loads(capsys.readouterr().out)["error"]["code"] == "NONE"

    def test_exit_code_and_noise(self, monkeypatch, capsys):
        def run(args):
            print("a library speaks")
            return CliResult({"x": 1}, lambda console, document: console.print("one"), exit_code=3)

        with_command(monkeypatch, run)
        assert frame.main(["--json", "probe"]) == 3
        out, err = capsys.readouterr()
        assert json.loads(out) == {"x": 1}
        assert "a library speaks" in err
        assert frame.main(["probe"]) == 3
        assert capsys.readouterr().out == "a library speaks\none\n"

    def test_negative_values(self, monkeypatch):
        seen = []
        with_command(
            monkeypatch,
            lambda args: seen.append(args.at) or CliResult({}, lambda *_: None),
        )
        probe = frame.import_module("")
        probe.add_probe = lambda parser: parser.add_argument("--at")
        for value in ("-90,0,1", "-.5", "-1e-3"):
            assert frame.main(["probe", "--at", value, "--json"]) == 0
            assert frame.main(["probe", f"--at={value}", "--json"]) == 0
        assert seen == ["-90,0,1", "-90,0,1", "-.5", "-.5", "-1e-3", "-1e-3"]

    def test_ctrl_c(self, monkeypatch, capsys):
        status, out, err = fails_with(monkeypatch, capsys, KeyboardInterrupt(), "--json")
        assert (status, out, err) == (130, "", "robocal: interrupted\n")


SLOW = """
import sys, time
from types import SimpleNamespace
from robocal_ros.cli import main as frame
from robocal_ros.cli.main import CliResult
def run(args):
    if args.wait:
        print("ready", file=sys.stderr, flush=True)
        time.sleep(30)
    lines = lambda console, document: [console.print("line") for _ in range(9999)]
    return CliResult({"x": "y" * 1000}, lines)
frame.COMMANDS = {"probe": frame.CliCommand("test:probe", "")}
frame.import_module = lambda name: SimpleNamespace(
    run_probe=run, add_probe=lambda p: p.add_argument("--wait", action="store_true"))
sys.exit(frame.main(sys.argv[1:]))
"""


class TestSignals:
    def test_interrupt(self):
        command = [sys.executable, "-c", SLOW, "probe", "--wait"]
        with subprocess.Popen(
            command,
            stderr=subprocess.PIPE,
            env=environment(),
            # Where the tests run in the background, a shell has them ignore Ctrl-C.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ) as process:
            try:
                assert process.stderr.readline() == b"ready\n"
                process.send_signal(signal.SIGINT)
                assert process.wait(timeout=60) == 130
                assert process.stderr.read() == b"robocal: interrupted\n"
            finally:
                process.kill()

    @pytest.mark.parametrize("more", [[], ["--json"]])
    def test_reader_goes_away(self, more):
        for code in (["-c", SLOW, "probe"], ["-m", "robocal_ros.cli.main", "--help"]):
            listen, speak = os.pipe()
            os.close(listen)
            done = subprocess.run(
                [sys.executable, *code, *more],
                stdout=speak,
                stderr=subprocess.PIPE,
                env=environment(),
                timeout=20,
                check=False,
            )
            os.close(speak)
            assert (done.returncode, done.stderr) == (0, b"")


def test_piped_tables_stay_whole(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    stream = io.StringIO()
    from robocal_ros.cli.main import show

    show(CliResult({}, lambda console, document: console.print("x" * 150)), stream)
    assert stream.getvalue() == "x" * 150 + "\n"


def test_runs_from_any_folder(tmp_path: Path):
    done = subprocess.run(
        [*COMMAND, "--version"], cwd=tmp_path, env=environment(), capture_output=True, check=True
    )
    assert done.stdout.startswith(b"robocal ")
    assert not list(tmp_path.iterdir())
    assert ROOT.is_absolute()
