# SPDX-License-Identifier: Apache-2.0
"""The demo: a cell keeps itself accurate, in closed loop and in real time; everything is simulated.

``make demo`` runs it. A simulated KR 150 has worked for three hours since its cold cell was
commissioned. The cell, thermal_node, tcf_node, joint_correction_node, maintenance_node,
recorder_node, plc_bridge_node and panel_node run as processes of their own, and so does the PLC:
heartbeat and calls by OPC UA (by ROS where asyncua is not installed). This script sends the
programme. In a gap the drift is measured; in the middle of the work after it a collision bends the
tool by 2 mm, and the next gap finds and mends that. At the end the bag is replayed, judged and told
in one page.
"""

import argparse
import json
import shutil
import socket
import sys
import time
import urllib.request
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from demo_output import Moment, Story, show, tell

from bench.live.cell import SERIAL, set_fault
from bench.live.graph import CellController, LiveError
from bench.live.plc import GAP_S, Judge, Plc
from bench.live.running import live_cell, validate
from bench.startup import ROOT
from robocal_ros.ground.errors import RobocalError

OUT = ROOT / "out"
COLLISION_MM = 2.0
PAGE_PORT = 8480  # or any, where that is taken
PAGE_S, PAGE_WITHIN_S = 3.0, 60.0  # of one request; until the node serves and knows the cell


class Demo:
    """One run of the story."""

    def __init__(self, controller: CellController, plc: Plc, folder: Path) -> None:
        self._controller, self._plc = controller, plc
        self._page = ""
        if find_spec("aiohttp"):  # of the extra [panel]
            port = _page_port()
            controller.start(folder, "panel_node", {"serial": SERIAL, "page_port": port})
            self._page = f"http://127.0.0.1:{port}"
            tell(f"the page for the people at the line: {self._page}")
        self._judge = Judge(controller)
        self.story = Story()

    def run(self) -> None:
        """The minutes that tell most."""
        plc, story = self._plc, self.story
        tell("the programme, as taught: the robot has drifted since the cell was commissioned")
        plc.produce()
        self._judged("drifted, nothing measured yet")
        tell("a gap: measure the drift, check the tool")
        story.gaps.append(plc.gap("gap-1", GAP_S))
        tell("the programme, corrected; in the middle of it a collision bends the tool")
        plc.produce(halfway=self._collide)
        self._judged(f"collision: tool bent by {COLLISION_MM:g} mm")
        tell("a gap: the check finds the bent tool, it is measured, accepted and verified")
        story.gaps.append(plc.gap("gap-2", GAP_S))
        tell("the programme, corrected for drift and tool")
        plc.produce()
        self._judged("after gap 2: tool measured")
        story.called_s = plc.called_s()
        if self._page:
            story.page = self._shown()
            tell(f"the page says {story.page['headline']}: {self._page}")

    def _shown(self) -> dict[str, Any]:
        """What the page shows now, by HTTP, as a browser gets it."""
        found: list[dict[str, Any]] = []

        def shows() -> bool:
            try:
                with urllib.request.urlopen(f"{self._page}/events", timeout=PAGE_S) as events:
                    for line in events:
                        if line.startswith(b"data: {"):
                            found.append(json.loads(line[len(b"data: ") :]))
                            return bool(found[-1].get("headline", "SILENT") != "SILENT")
            except OSError:  # a busy machine
                pass
            return False

        self._controller.wait(shows, "the page", PAGE_WITHIN_S)
        return found[-1]

    def _collide(self) -> None:
        self._judged("after gap 1: drift measured")
        set_fault(self._controller.call, "collision", COLLISION_MM)

    def _judged(self, words: str) -> None:
        found = self._judge.now()
        moment = Moment(words, found.without_mm, found.with_mm, *self._plc.line())
        self.story.moments.append(moment)


def _page_port() -> int:
    with socket.socket() as taken:
        try:
            taken.bind(("127.0.0.1", PAGE_PORT))
        except OSError:
            taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def main() -> int:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT, help="folder of report, bag and logs")
    parser.add_argument("--no-open", action="store_true", help="do not open the report")
    options = parser.parse_args()
    begin_s = time.monotonic()
    folder = options.out.resolve()
    recordings = folder / "recordings"
    for old in (folder / "state", recordings, folder / "report", folder / "plc"):
        shutil.rmtree(old, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with live_cell(folder, recordings, tell) as (controller, plc):
            demo = Demo(controller, plc, folder)
            nodes = len(controller.pids)
            demo.run()
        story = demo.story
        tell("the recorded bag, replayed and judged")
        document = json.dumps(story.document(), indent=1, allow_nan=False) + "\n"
        (folder / "story.json").write_text(document, encoding="utf-8")
        page = validate(recordings, folder / "report")
    except (LiveError, RobocalError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    show(story, page, time.monotonic() - begin_s, nodes, opened=not options.no_open)
    return 0


if __name__ == "__main__":
    sys.exit(main())
