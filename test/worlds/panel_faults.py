# SPDX-License-Identifier: Apache-2.0
"""What the page must send a person to for each of the simulator's faults that must be told."""

from collections.abc import Mapping

from robocal_ros.cell_sim.faults import Fault
from robocal_ros.panel.state import STATUS, PanelState, Values
from robocal_ros.panel.words import LANGUAGES, document

TOOL_BENT = ("The tool is bent", "Das Werkzeug ist verbogen", "工具弯了")
WRONG_TOOL = ("Mount the right tool", "Richtiges Werkzeug montieren", "装上正确的工具")
KNOCKED = (
    "Look at sensor, ball and robot base",
    "Sensor, Kugel und Roboterfuß",
    "查看传感器、测量球",
)
STATION = ("Look at the beam station", "Lichtschranken-Station ansehen", "查看光束测量站")
BEAMS = ("Look at the light beams", "Lichtschranken ansehen", "查看光束传感器")
CLOCKS = ("The clocks of robot", "Die Uhren von Roboter", "时钟不一致")
NETWORK = ("network cable", "Netzwerkkabel", "网线")
ASTRAY = ("The robot is not where it should be", "nicht, wo er sein soll", "不在应在的位置")
FIXTURE_MOVED = ("The fixture stands elsewhere", "Die Vorrichtung steht anders", "夹具位置变了")

SENDS_TO: Mapping[Fault, tuple[str, str, str]] = {
    "collision": TOOL_BENT,
    "wrong_tool": WRONG_TOOL,
    "sensor_knocked": KNOCKED,
    "sphere_knocked": KNOCKED,
    "moved_by_hand": KNOCKED,
    "station_knocked": STATION,
    "station_knocked_shift": STATION,
    "beam_dirty": BEAMS,
    "beam_x_dead": BEAMS,
    "beam_y_dead": BEAMS,
    "beams_dead": BEAMS,
    "chatter": BEAMS,
    "lost_edge": BEAMS,
    "double_edge": BEAMS,
    "swapped_cables": BEAMS,
    "wrong_station": BEAMS,
    "input_latency": CLOCKS,
    "clock_jump": CLOCKS,
    "lost_messages": NETWORK,
    "joints_silent": NETWORK,
    "frozen_clock": NETWORK,
    "frozen_encoder": ASTRAY,
    "fixture_moved": FIXTURE_MOVED,
}


def told(panel: PanelState, now_s: float) -> dict[str, str]:
    """What the page says to do first, by language."""
    task = panel.tasks(now_s)[0]
    return {name: document(name)["instructions"][task.key] for name in LANGUAGES}


def wrongly_told(fault: Fault, panel: PanelState, now_s: float) -> str:
    """Why the page does not send to what has this fault; empty: it does, in each language."""
    said = told(panel, now_s)
    for words, name in zip(SENDS_TO[fault], LANGUAGES, strict=True):
        if words not in said[name]:
            return f"{fault}: '{words}' is not in '{said[name]}'"
    return ""


def heard(panel: PanelState, sources: Mapping[str, Values], now_s: float) -> None:
    """Let the nodes say it, twice: one message alone may be a dead node's."""
    for stamp in (1, 2):
        for name, values in sources.items():
            panel.show(name, values, stamp, now_s, 1e9)
    assert STATUS in sources
