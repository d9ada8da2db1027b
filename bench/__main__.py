# SPDX-License-Identifier: Apache-2.0
"""Make every table, print it, and write it to out/bench, a file for each part: ``python -m bench``.

With ``--keep`` also to bench/results, and to docs/figures as the documents refer to it.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: the comparison is per thread

import argparse
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from bench.tables import KEPT, OUT, PAGES, Table, about, show

# Each part's module, which makes its ``tables()``; imported when asked for, since some load much.
PARTS = {
    "real_data": "real_data",
    "real_few": "real_few",
    "monte_carlo": "monte_carlo",
    "masses": "masses",
    "thermal": "thermal",
    "tool": "tool",
    "hand_eye": "hand_eye",
    "hand_eye_real": "hand_eye_real",
    "hand_eye_camera": "hand_eye_camera",
    "hand_eye_tracker": "hand_eye_tracker",
    "speed": "times",
    "correction": "correction",
    "startup": "startup",
    "packages": "packages",
    "demo": "demo",
    "correction_stream": "correction_stream",
    "closed_loop": "closed_loop.tables",
    "fault_checks": "closed_loop.checks",
    "knocks": "closed_loop.knocks",
    "fixture": "fixture",
    "programs": "programs",
    "files": "files",
    "urdf": "urdf",
    "replay_speed": "replay_speed",
}


# Accuracy, each on one core: these share the machine. The others time something, or take all cores.
TOGETHER = (
    "real_data",
    "real_few",
    "monte_carlo",
    "masses",
    "thermal",
    "tool",
    "hand_eye",
    "hand_eye_real",
    "hand_eye_camera",
    "hand_eye_tracker",
    "fixture",
    "programs",
)

Made = tuple[Sequence[Table] | None, float]


def _made(part: str) -> Made:
    """The tables of a part, None where it could not be measured, and how long it took, s."""
    start = time.monotonic()
    made: Sequence[Table] | None = None
    try:
        made = importlib.import_module(f"bench.{PARTS[part]}").tables()
    except subprocess.CalledProcessError as error:
        print(error.stderr, file=sys.stderr)
    return made, time.monotonic() - start


def _all_made(parts: Sequence[str]) -> Iterator[tuple[str, Made]]:
    """Those that share the machine first, then the others one by one."""
    together = [part for part in parts if part in TOGETHER]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        yield from zip(together, pool.map(_made, together), strict=True)
    for part in parts:
        if part not in TOGETHER:
            yield part, _made(part)


def _write(
    folder: Path, pages: Path, part: str, tables: Sequence[Table], about: dict[str, str]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    document = {"about": about, "tables": [table.document() for table in tables]}
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / f"{part}.json").write_text(text + "\n")
    words = ", ".join(f"{name} {value}" for name, value in about.items())
    body = "\n".join(table.markdown() for table in tables)
    (pages / f"{part}.md").write_text(f"Made by `python -m bench {part}`: {words}.\n\n{body}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chosen parts. 1 when a goal is missed."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("part", nargs="*", choices=[*PARTS, []], help=f"of {', '.join(PARTS)}")
    parser.add_argument(
        "--keep", action="store_true", help="write bench/results and docs/figures too"
    )
    given = parser.parse_args(arguments)
    chosen = [name for name in PARTS if not given.part or name in given.part]
    tables: list[Table] = []
    missed: list[str] = []
    for name, (made, took_s) in _all_made(chosen):
        if made is None:
            missed.append(f"{name} could not be measured")
            continue
        show(made)
        tables += made
        made_by = about(took_s)
        _write(OUT, OUT, name, made, made_by)
        if given.keep and made:
            _write(KEPT, PAGES, name, made, made_by)
    missed += [table.title for table in tables if not table.met]
    for title in missed:
        print(f"goal missed: {title}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
