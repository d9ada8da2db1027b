# SPDX-License-Identifier: Apache-2.0
"""The calibration history as the page shows it, read anew whenever somebody has changed it."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.history.calibrations import HistoryReader
from robocal_ros.history.history_file import damage_notice
from robocal_ros.history.history_records import TOOL

LISTED, TOOLS = 50, 20  # newest results, and tools among them
WAIT_S = 0.5  # for another process's change
NOTHING: Mapping[str, Any] = {
    "trouble": "", "absent": "", "in_force": [], "results": [], "tools": [],
}  # fmt: skip


class Records:
    """One robot's history; for one thread, which may wait for the disk."""

    def __init__(self, state_dir: Path | None) -> None:
        self._state_dir = state_dir
        self._reader: HistoryReader | None = None
        self._shown: tuple[str, int, str] | None = None

    def look(self, serial: str) -> Mapping[str, Any] | None:
        """What is to be shown of a robot; None: as the last time."""
        shown: Mapping[str, Any]
        try:
            if self._reader is None or self._reader.serial != serial:
                self.close()
                self._reader = HistoryReader.open(
                    serial,
                    state_dir=self._state_dir,
                    create=False,
                    owner=False,
                    busy_timeout_s=WAIT_S,
                )
            damage = damage_notice(self._reader.path)
            seen = serial, self._reader.data_version(), damage
            if seen == self._shown:
                return None
            shown = {**NOTHING, **_document(self._reader), "trouble": damage}
        except InputError as error:  # nothing was proposed yet, or it is kept on another machine
            seen = serial, -1, str(error)
            if seen == self._shown:
                return None
            shown = {**NOTHING, "absent": str(error)}
        except RobocalError as error:
            self.close()
            seen = serial, -1, str(error)
            if seen == self._shown:
                return None
            shown = {**NOTHING, "trouble": str(error)}
        self._shown = seen
        return shown

    def close(self) -> None:
        """Leave the file."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _document(history: HistoryReader) -> dict[str, Any]:
    """As `robocal history list --json` has it; of each tool its tip, and how far it has moved."""
    results = [entry.document() for entry in history.list(LISTED)]
    tips: list[tuple[Mapping[str, Any], list[float] | None]] = []
    for result in [r for r in results if r["kind"] == TOOL][:TOOLS]:
        tip = history.document(result["id"]).get("tcp_mm")
        tips.append((result, tip))
    tools = []
    for (tool, tip), (_, before) in zip(tips, [*tips, ({}, None)][1:], strict=True):
        moved = None if tip is None or before is None else math.dist(tip, before)
        tools.append({"id": tool["id"], "tcp_mm": tip, "moved_mm": moved})
    return {
        "in_force": [head.calibration_id for head in history.heads() if head.calibration_id],
        "results": results,
        "tools": tools,
    }
