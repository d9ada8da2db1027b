# SPDX-License-Identifier: Apache-2.0
"""What the parts of the soak that also run alone have in common."""

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

from bench.tables import PAGES, Table, about, show

HOUR_S = 3600.0


def soak_main(
    name: str,
    soak: Callable[[Any], Table],
    words: str,
    arguments: Sequence[str] | None,
    unit: str = "seconds",
    usual: float = HOUR_S,
) -> int:
    """Run so much of one part, keep its table as a figure; 1 when a goal is missed."""
    parser = argparse.ArgumentParser(prog=f"python -m bench.{name}", description=words)
    parser.add_argument(
        f"--{unit}", dest="amount", type=type(usual), default=usual, help="how much"
    )
    parser.add_argument("--keep", action="store_true", help="write docs/figures too")
    given = parser.parse_args(arguments)
    start = time.monotonic()
    table = soak(given.amount)
    show([table])
    if given.keep:
        command = f"python -m bench.{name} --{unit} {given.amount:g} --keep"
        facts = ", ".join(f"{name} {x}" for name, x in about(time.monotonic() - start).items())
        (PAGES / f"{name}.md").write_text(f"Made by `{command}`: {facts}.\n\n{table.markdown()}")
    return 0 if table.met else 1
