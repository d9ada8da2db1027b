# SPDX-License-Identifier: Apache-2.0
"""What the parts of the soak that also run alone have in common."""

import argparse
import time
from collections.abc import Callable, Sequence

from bench.tables import PAGES, Table, about, show

HOUR_S = 3600.0


def soak_main(
    name: str, soak: Callable[[float], Table], words: str, arguments: Sequence[str] | None
) -> int:
    """Run one part for ``--seconds``, keep its table as a figure; 1 when a goal is missed."""
    parser = argparse.ArgumentParser(prog=f"python -m bench.{name}", description=words)
    parser.add_argument("--seconds", type=float, default=HOUR_S, help="how long")
    parser.add_argument("--keep", action="store_true", help="write docs/figures too")
    given = parser.parse_args(arguments)
    start = time.monotonic()
    table = soak(given.seconds)
    show([table])
    if given.keep:
        command = f"python -m bench.{name} --seconds {given.seconds:g} --keep"
        facts = ", ".join(f"{name} {x}" for name, x in about(time.monotonic() - start).items())
        (PAGES / f"{name}.md").write_text(f"Made by `{command}`: {facts}.\n\n{table.markdown()}")
    return 0 if table.met else 1
