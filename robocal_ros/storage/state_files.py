"""Small documents of a robot beside its history: whole or not at all."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocal_ros.core.errors import InputError, StorageError
from robocal_ros.storage.files import read_text, write_text
from robocal_ros.storage.history_paths import made_folder_beside


class StateFile:
    """One JSON document, ``<serial>/<name>/state.json`` beside a history.

    Raises
    ------
    StorageError
        When its folder cannot be made.
    """

    def __init__(self, history: Path, name: str) -> None:
        self.path = made_folder_beside(history, name) / "state.json"

    def load(self) -> Mapping[str, Any] | None:
        """The document; None before the first.

        Raises
        ------
        StorageError
            When it cannot be read.
        """
        if not self.path.exists():
            return None
        try:
            document = json.loads(read_text(self.path, "state file"))
        except (InputError, ValueError) as error:
            words = f"{self.path} cannot be read: {error}; restore it, or move it away"
            raise StorageError(words) from error
        if not isinstance(document, dict):
            raise StorageError(f"{self.path} holds no document: move it away")
        return document

    def save(self, document: Mapping[str, Any]) -> None:
        """Put a document in its place.

        Raises
        ------
        StorageError
            When it cannot be written; the one before is still there.
        """
        try:
            write_text(self.path, json.dumps(document, allow_nan=False))
        except InputError as error:
            raise StorageError(str(error)) from error
