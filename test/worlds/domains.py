"""ROS domains of tests that run beside each other."""

import contextlib
import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

# Their ports lie below those that Linux hands out to any program.
DOMAINS = range(1, 102)


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """Reserve a ROS domain that no other test on this machine uses."""
    for domain in DOMAINS:
        path = Path(tempfile.gettempdir(), f"robocal_test_domain_{domain}.lock")
        with contextlib.suppress(BlockingIOError), path.open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield domain
            return
    pytest.fail("all ROS domains are in use by other tests")
