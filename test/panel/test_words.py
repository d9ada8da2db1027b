# SPDX-License-Identifier: Apache-2.0
"""The table of texts is complete: each code, state and step, in each language."""

import re
from pathlib import Path

import pytest

from robocal_ros.ground.errors import Code
from robocal_ros.panel import state
from robocal_ros.panel.words import LANGUAGES, STEPS, instruction_key, step_of, table
from robocal_ros.tool.session import FULL, LASER, QUICK, WITNESS

ROOT = Path(__file__).parents[2]
PAGE = "".join(
    (ROOT / "robocal_ros/panel" / f"panel.{kind}").read_text() for kind in ("js", "html")
)
TEXTS = [
    (f"{section}/{key}", text) for section, texts in table().items() for key, text in texts.items()
]
LONGEST = {"en": 110, "de": 110, "zh": 45}  # of a sentence: it is read from an arm's length


def constants(message: str) -> tuple[str, ...]:
    """Names of a message's first enumeration, by their numbers."""
    text = (ROOT / "msg_defs" / "msg" / f"{message}.msg").read_text()
    first = text[text.index("uint8 NONE=0") :].split("\n\n")[0]
    found = re.findall(r"^uint8\s+([A-Z_]+)\s*=\s*(\d+)", first, re.M)
    assert [int(number) for _, number in found] == list(range(len(found)))
    return tuple(name for name, _ in found)


def test_every_code_says_what_to_do_whoever_gives_it():
    for code in Code:
        for source in ("fault", "drift", "tool", "anybody"):
            assert instruction_key(code, source) in table()["instructions"]
    keys = {key.split("/")[0] for key in table()["instructions"]}
    assert keys - {"state", "correction"} == {code.name for code in Code}


@pytest.mark.parametrize(
    ("message", "names"),
    [
        ("AccuracyState", state.LEVELS),
        ("MaintenanceStatus", state.MAINTENANCE),
        ("CorrectionStatus", state.CORRECTIONS),
    ],
)
def test_every_state_of_a_message_has_its_instruction(message, names):
    assert names == constants(message)
    section = "correction" if message == "CorrectionStatus" else "state"
    for name in names[1:]:
        assert f"{section}/{name}" in table()["instructions"]


def test_every_headline_has_a_sentence():
    heads = {*state.LEVELS[1:], *state.MOVES, state.FAULT, state.SILENT}
    assert table()["sentences"].keys() == heads
    for head in heads:
        assert f"{head}:" in PAGE  # its sign: colours alone do not tell
        css = (ROOT / "robocal_ros/panel/panel.css").read_text()
        assert f'[data-level="{head}"]' in css


def test_every_step_of_the_maintenance_has_a_text():
    said = set()
    for file in (ROOT / "robocal_ros" / "maintenance").glob("*.py"):
        said |= set(re.findall(r'doing = f?"([^"]+)"', file.read_text()))
        said |= set(re.findall(r'cell\.doing = None, "([^"]+)"', file.read_text()))
    assert len(said) >= 8
    for words in said:
        for mode in (QUICK, FULL, WITNESS, LASER):
            spoken = re.sub(r"\{mode\}", mode, words)
            key, _ = step_of(re.sub(r"\{[^}]+\}", "3", spoken))
            assert key in table()["steps"], words
    assert STEPS.keys() == table()["steps"].keys()


@pytest.mark.parametrize(("key", "text"), TEXTS, ids=[key for key, _ in TEXTS])
def test_a_text_is_there_in_each_language_short_and_with_the_same_numbers(key, text):
    assert text.keys() == LANGUAGES.keys()
    for language, words in text.items():
        assert words == words.strip() or key in {"labels/sent", "labels/failed"}
        assert re.findall(r"\{\d\}", words) == re.findall(r"\{\d\}", text["en"])
        for sentence in re.split(r"(?<=[.?!]) |(?<=[\u3002\uff1f\uff01])", words):
            assert len(sentence) <= LONGEST[language], sentence
    assert re.search(r"[\u4e00-\u9fff]", text["zh"])


def test_the_page_uses_each_label_and_has_each_that_it_uses():
    used = set(re.findall(r'label\("(\w+)"', PAGE)) | set(re.findall(r'data-label="(\w+)"', PAGE))
    assert used <= table()["labels"].keys()
    composed = {*(f"really_{act}" for act in ("run", "accept", "reject", "acknowledge"))}
    composed |= {"in_force", "pending", "stale", "refused", "rejected", "superseded"}
    composed |= {"rolled_back", "thermal", "tool"}
    for key in table()["labels"].keys() - used - composed:
        assert f'"{key}"' in PAGE, key
