# SPDX-License-Identifier: Apache-2.0
"""What two histories must have in common when they were made of the same samples and commands."""

import json

from robocal_ros.history.calibrations import CalibrationHistory


def content(history: CalibrationHistory) -> str:
    """Everything but ids, wall-clock times and file names, with every bit of every number."""
    number = {entry.id: i for i, entry in enumerate(reversed(history.list(10_000)))}
    entries = [
        {
            "kind": entry.kind,
            "model_hash": entry.model_hash,
            "based_on": entry.based_on,
            "cycle": entry.cycle_id,
            "stamp": entry.stamp_ns,
            "made_by": [entry.method, entry.software],
            "verdict": [entry.code.name, entry.reason, entry.candidate_rms_mm],
            "state": entry.state.value,
            "revision": entry.revision,
            "document": history.document(entry.id),
            "model": history.model(entry.id),
            "inputs": {
                name: [str(array.dtype), array.tolist()]
                for name, array in history.inputs(entry.id).items()
            },
        }
        for entry in history.list(10_000)
    ]
    decisions = [
        [d.kind, d.action.value, number.get(d.calibration_id), d.by, d.reason, d.head_after]
        for d in history.decisions()
    ]
    return json.dumps([entries, decisions], sort_keys=True)
