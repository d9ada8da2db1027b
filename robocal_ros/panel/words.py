# SPDX-License-Identifier: Apache-2.0
"""The texts of the page, of ``words.yaml``, and which of them says what a code or a step means."""

import functools
import re
from collections.abc import Mapping
from importlib.resources import files

import yaml

from robocal_ros.ground.errors import Code

LANGUAGES: Mapping[str, str] = {"en": "English", "de": "Deutsch", "zh": "中文"}

STEPS: Mapping[str, str] = {
    "begins": r"begins",
    "thermal_begins": r"thermal cycle begins",
    "way": r"on its way to measuring pose (\d+) of (\d+)",
    "pose": r"measuring pose (\d+) of (\d+)",
    "thermal_ends": r"thermal cycle ends",
    "fixture_way": r"on its way to fixture pose (\d+) of (\d+)",
    "fixture_pose": r"measuring fixture pose (\d+) of (\d+)",
    "fixture_ends": r"fixture measurement ends",
    "check": r"tool measurement \(quick\)",
    "full": r"tool measurement \((?:full|reference)\)",
    "mandrel": r"tool measurement \(witness\)",
    "beams": r"tool measurement \(laser\)",
    "home": r"on its way home",
    "broken_off": r"is broken off",
    "fault": r"fault",
}
"""What maintenance_node says that it does, by the keys of its texts; groups are their numbers."""

TOO_SHORT = re.compile(
    r"(?:beam station|tool measurement \(\w+\)|fixture): the gap is [\d.]+ s too short"
)
"""How maintenance_node says in a result's message that something was due and did not fit."""

Table = Mapping[str, Mapping[str, Mapping[str, str]]]


@functools.cache
def table() -> Table:
    """Texts by section, key and language."""
    text = (files("robocal_ros.panel") / "words.yaml").read_text(encoding="utf-8")
    found: Table = yaml.safe_load(text)
    return found


def instruction_key(code: Code, source: str) -> str:
    """Key of what to do: the code's own instruction from this source, else the code's."""
    special = f"{code.name}/{source}"
    return special if special in table()["instructions"] else code.name


def step_of(doing: str) -> tuple[str, list[str]]:
    """Key and numbers of what goes on; ``other`` with the words themselves where none fits."""
    for key, pattern in STEPS.items():
        if found := re.fullmatch(pattern, doing):
            return key, list(found.groups())
    return "other", [doing]


def document(language: str) -> dict[str, dict[str, str]]:
    """All texts of one language, by section and key, for the browser."""
    return {
        section: {key: text[language] for key, text in texts.items()}
        for section, texts in table().items()
    }
