"""Sessions that start where a recorded one did."""

import json

import pytest
from hand_eye_driver import ARM
from tool_driver import config_of, noisy_cell

from robocal_ros.core.documents import model_document
from robocal_ros.core.errors import InputError
from robocal_ros.core.proposals import THERMAL
from robocal_ros.sessions import hand_eye_recorded, records, tool_recorded
from robocal_ros.sessions.events import Command
from robocal_ros.sessions.hand_eye import HandEyeSession
from robocal_ros.sessions.hand_eye_config import HandEyeConfig
from robocal_ros.sessions.seeding import session_as_recorded
from robocal_ros.sessions.thermal import ThermalSession
from robocal_ros.sessions.thermal_config import ThermalConfig
from robocal_ros.sessions.tool import ToolSession
from robocal_ros.storage.calibrations import CalibrationHistory

KINDS = {
    "thermal": (
        lambda history: ThermalSession(ARM, history, ThermalConfig(), "test"),
        records.configuration,
        session_as_recorded,
    ),
    "tool": (
        lambda history: ToolSession(ARM, history, config_of(noisy_cell()), "test"),
        tool_recorded.configuration,
        tool_recorded.tool_session_as_recorded,
    ),
    "hand-eye": (
        lambda history: HandEyeSession(ARM, history, HandEyeConfig(), "test"),
        hand_eye_recorded.configuration,
        hand_eye_recorded.hand_eye_session_as_recorded,
    ),
}


@pytest.fixture
def history(tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as opened:
        yield opened


@pytest.mark.parametrize(
    ("kind", "broken"), [*((kind, "config") for kind in KINDS), ("thermal", "tracker")]
)
def test_a_recording_that_cannot_be_read_leaves_the_history_empty(history, kind, broken):
    """What it left would be taken for the user's own at the next try."""
    begun, configuration, as_recorded = KINDS[kind]
    configured = configuration(begun(history), {})
    arguments = dict(configured.arguments) | {"model": model_document(ARM)}
    whole = Command(configured.name, json.loads(json.dumps(arguments)))
    with pytest.raises(InputError, match="cannot be read"):
        as_recorded(ARM, history, Command(whole.name, whole.arguments | {broken: {"x": 1}}), "test")
    assert not history.list(1)
    as_recorded(ARM, history, whole, "test")
    assert history.head(THERMAL).model == whole.arguments["model"]
