# SPDX-License-Identifier: Apache-2.0
"""The layouts of config/ show topics and fields that exist."""

import json
import re
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from robocal_ros.bags.mcap_files import message_class, recorded_name
from robocal_ros.bags.recorder_node import TOPICS

LAYOUTS = Path(__file__).parents[2] / "config" / "layouts"
# Without the namespace; that nodes offer them is shown by the tests of the cell.
TYPES = {
    "/accuracy_state": "robocal_msgs/msg/AccuracyState",
    "/beam_events": "robocal_msgs/msg/BeamEvent",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/joint_correction_node/correction": "robocal_msgs/msg/JointOffset",
    "/joint_correction_node/status": "robocal_msgs/msg/CorrectionStatus",
    "/maintenance_node/status": "robocal_msgs/msg/MaintenanceStatus",
    "/motor_temperatures": "sensor_msgs/msg/Temperature",
    "/tcf_node/tool": "robocal_msgs/msg/ToolFrame",
    "/thermal_node/accuracy": "robocal_msgs/msg/AccuracyState",
    "/thermal_node/quality": "robocal_msgs/msg/CalibrationQuality",
}


def foxglove() -> list[str]:
    """Message paths of all panels, fields after dots."""
    content = json.loads((LAYOUTS / "foxglove_cell.json").read_text())
    panels = content["configById"]
    shown = set(re.findall(r'"([A-Z]\w+!\w+)"', json.dumps(content["layout"])))
    assert shown == set(panels)  # each panel has its place
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    topics = [p.get("topicPath", p.get("topicToRender")) for p in panels.values()]
    return paths + [topic for topic in topics if topic]


def plotjuggler() -> list[str]:
    """Curves of all plots, fields after slashes."""
    root = ET.parse(LAYOUTS / "plotjuggler_cell.xml").getroot()
    return [curve.attrib["name"] for curve in root.iter("curve")]


PATHS = [*foxglove(), *plotjuggler()]


@pytest.mark.parametrize("file", ["foxglove_cell.json", "plotjuggler_cell.xml"])
def test_the_command_of_the_page_puts_a_layout_into_a_namespace(file):
    page = (LAYOUTS.parents[1] / "docs" / "cell_launch.md").read_text()
    script = re.search(r"sed -E '(.*)'", page)
    assert script
    done = subprocess.run(
        ["sed", "-E", script[1], LAYOUTS / file], capture_output=True, text=True, check=True
    )
    topics = [name for name in TYPES if name != "/diagnostics"]
    before = (LAYOUTS / file).read_text()
    assert '"/' in before
    for name in topics:
        assert done.stdout.count(f'"/robot_1{name}') == before.count(f'"{name}')
    assert done.stdout.count('"/diagnostics') == before.count('"/diagnostics')
    assert done.stdout.count('"/robot_1/') + done.stdout.count('"/diagnostics') == before.count(
        '"/'
    )


@pytest.mark.parametrize("file", ["foxglove_cell.json", "plotjuggler_cell.xml"])
def test_the_command_of_the_page_gives_the_names_of_a_recording(file):
    page = (LAYOUTS.parents[1] / "docs" / "cell_launch.md").read_text()
    _, script = re.findall(r"sed -E '(.*)'", page)
    before = (LAYOUTS / file).read_text()
    done = subprocess.run(
        ["sed", "-E", script, LAYOUTS / file], capture_output=True, text=True, check=True
    )
    for name, msgtype in TYPES.items():
        assert done.stdout.count(f'"{recorded_name(name, msgtype)}') == before.count(f'"{name}')


@pytest.mark.parametrize("path", PATHS)
def test_the_field_exists(path):
    topic = next(t for t in sorted(TYPES, key=len, reverse=True) if path.startswith(t))
    value = message_class(TYPES[topic])()
    for field in re.findall(r"[^./]+", path.removeprefix(topic)):
        name = field.split("[")[0]
        assert name in value.get_fields_and_field_types(), f"{path}: no field {name}"
        value = getattr(value, name)


def test_a_recording_has_what_is_shown():
    assert set(TYPES) <= {f"/{topic.lstrip('/')}" for topic in TOPICS}


def test_each_type_is_shown():
    assert {t for t in TYPES if any(p.startswith(t) for p in PATHS)} == set(TYPES)
