"""The package says the same of itself in every place."""

import re
from pathlib import Path
from xml.etree import ElementTree

import robocal_ros
from robocal_ros.core.codes import Code

ROOT = Path(__file__).parent.parent


def test_one_version_everywhere() -> None:
    manifests = [ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"]
    versions = [ElementTree.parse(path).findtext("version") for path in manifests]
    assert versions == [robocal_ros.__version__] * 2


def test_the_codes_of_the_message_are_the_codes_of_the_core() -> None:
    text = (ROOT / "msg_defs" / "msg" / "CalibrationQuality.msg").read_text()
    constants = {name: int(value) for name, value in re.findall(r"^uint8 (\w+)=(\d+)$", text, re.M)}
    assert constants == {code.name: code.value for code in Code}


def test_every_interface_is_built() -> None:
    built = set(
        re.findall(r'"((?:msg|srv)/\w+\.\w+)"', (ROOT / "msg_defs/CMakeLists.txt").read_text())
    )
    folders = (ROOT / "msg_defs" / "msg", ROOT / "msg_defs" / "srv")
    present = {f"{folder.name}/{path.name}" for folder in folders for path in folder.iterdir()}
    assert built == present
