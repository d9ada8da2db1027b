# SPDX-License-Identifier: Apache-2.0
"""ROS domains of tests that run beside each other."""

import contextlib
import fcntl
import itertools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

# Their ports lie below those that Linux hands out to any program.
DOMAINS = range(1, 102)
# One after the other, each process from another on: what is left of a test's graph, of which Python
# or DDS may yet hold a part, is not in the next one's.
_FIRST = os.getpid() % len(DOMAINS)
_round = itertools.cycle([*DOMAINS[_FIRST:], *DOMAINS[:_FIRST]])


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """Reserve a ROS domain that no other test on this machine uses."""
    for domain in itertools.islice(_round, len(DOMAINS)):
        path = Path(tempfile.gettempdir(), f"robocal_test_domain_{domain}.lock")
        with contextlib.suppress(BlockingIOError), path.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield domain
            return
    pytest.fail("all ROS domains are in use by other tests")
