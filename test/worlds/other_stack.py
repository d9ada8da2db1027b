# SPDX-License-Identifier: Apache-2.0
"""A PLC by node-opcua (``test/plc/other_stack.cjs``), which shares no code with asyncua."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.serialization import Encoding

from bench.live.opc_ua import OPERATOR
from robocal_ros.plc import access

SCRIPT = Path(__file__).parents[1] / "plc" / "other_stack.cjs"
LONGER_S = 120.0  # than the gap: it connects, waits for the gap to be open, and leaves


def gap_by_another_stack(
    graph: Any, security: Path, port: int, folder: Path, cycle: str, gap_s: float
) -> dict[str, Any]:
    """What it has seen in one gap, given and ended by it alone; skips where it is not installed."""
    node = shutil.which("node")
    look = [str(node), "-e", "require('node-opcua-client')"]
    if node is None or subprocess.run(look, capture_output=True, check=False).returncode:
        pytest.skip("no node-opcua-client: npm install it, and name its node_modules in NODE_PATH")
    own = security / access.CLIENTS / "line.der"
    pem = folder / "line.pem"
    pem.write_bytes(access.read_certificate(own).public_bytes(Encoding.PEM))
    url, key = f"opc.tcp://127.0.0.1:{port}/robocal", own.with_name("line_key.pem")
    with (folder / "seen").open("w") as output, (folder / "said").open("w") as errors:
        plc = subprocess.Popen(
            [node, SCRIPT, url, pem, key, *OPERATOR, cycle, f"{gap_s:g}"],
            env=os.environ | {"HOME": str(folder), "XDG_CONFIG_HOME": str(folder)},
            stdout=output,
            stderr=errors,
        )
    try:
        graph.spin_until(lambda: plc.poll() is not None, "the other stack", gap_s + LONGER_S)
    finally:
        plc.kill()
    assert plc.returncode == 0, (folder / "said").read_text()
    *_, seen = (folder / "seen").read_text().splitlines()  # after what node-opcua warns of
    return dict(json.loads(seen))
