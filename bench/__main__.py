"""Make every table, print it, and write it to out/bench, a file for each part: ``python -m bench``.

With ``--keep`` also to docs/figures, where the documents refer to it.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: the comparison is per thread

import argparse
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from bench.tables import Table, show

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out" / "bench"
KEPT = ROOT / "docs" / "figures"  # the last figures that stand in the documents


def _parts() -> dict[str, Callable[[], Sequence[Table]]]:
    from bench import (
        correction,
        correction_stream,
        files,
        hand_eye,
        hand_eye_camera,
        hand_eye_profiles,
        hand_eye_tracker,
        monte_carlo,
        real_data,
        replay_speed,
        speed,
        startup,
        thermal,
        tool,
    )
    from bench.closed_loop import checks
    from bench.closed_loop import tables as closed_loop

    def times() -> Sequence[Table]:
        return [
            *speed.tables(),
            *(of.speed_table() for of in (thermal, tool, hand_eye_profiles, hand_eye_camera)),
        ]

    def start() -> Sequence[Table]:
        if startup.EXECUTABLES.is_dir():
            return [startup.start_times()]
        print("no nodes in install/ (run `make setup`): their start is left out")
        return []

    def streams() -> Sequence[Table]:
        return correction_stream.tables() if startup.EXECUTABLES.is_dir() else []

    return {
        "real_data": real_data.tables,
        "monte_carlo": monte_carlo.tables,
        "thermal": thermal.tables,
        "tool": tool.tables,
        "hand_eye": hand_eye.tables,
        "hand_eye_camera": hand_eye_camera.tables,
        "hand_eye_tracker": hand_eye_tracker.tables,
        "speed": times,
        "correction": correction.tables,
        "startup": start,
        "correction_stream": streams,
        "closed_loop": closed_loop.tables,
        "fault_checks": checks.tables,
        "files": lambda: [files.file_times()],
        "replay_speed": replay_speed.tables,
    }


def _commit() -> str:
    """The commit, with a mark when files differ from it."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
        return done.stdout.strip() if done.returncode == 0 else ""

    changed = git("status", "--porcelain", "--", "robocal_ros", "bench", "config")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")


def about(seconds: float) -> dict[str, str]:
    """Where and when figures were made."""
    import numpy
    import scipy

    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": _commit(),
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "machine": platform.machine(),
        "duration_s": f"{seconds:.0f}",
    }


def _write(folder: Path, part: str, tables: Sequence[Table], about: dict[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    document = {"about": about, "tables": [table.document() for table in tables]}
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / f"{part}.json").write_text(text + "\n")
    words = ", ".join(f"{name} {value}" for name, value in about.items())
    body = "\n".join(table.markdown() for table in tables)
    (folder / f"{part}.md").write_text(f"Made by `python -m bench {part}`: {words}.\n\n{body}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chosen parts. 1 when a goal is missed."""
    parts = _parts()
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("part", nargs="*", choices=[*parts, []], help=f"of {', '.join(parts)}")
    parser.add_argument("--keep", action="store_true", help="write docs/figures too")
    given = parser.parse_args(arguments)
    chosen = given.part
    tables: list[Table] = []
    missed: list[str] = []
    for name, make in parts.items():
        if chosen and name not in chosen:
            continue
        start = time.monotonic()
        try:
            made = make()
        except subprocess.CalledProcessError as error:
            print(error.stderr, file=sys.stderr)
            missed.append(f"{name} could not be measured")
            continue
        show(made)
        tables += made
        made_by = about(time.monotonic() - start)
        for folder in (OUT, KEPT) if given.keep and made else (OUT,):
            _write(folder, name, made, made_by)
    missed += [table.title for table in tables if not table.met]
    for title in missed:
        print(f"goal missed: {title}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
