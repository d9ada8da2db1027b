"""Small documents of a robot beside its history: whole or not at all, a power cut included."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocal_ros.core.errors import InputError, StateLostError, StorageError
from robocal_ros.storage.files import read_text, sync_folder, write_text
from robocal_ros.storage.history_paths import made_folder_beside


class StateFile:
    """One JSON document, ``<serial>/<name>/state.json`` beside a history; empty at first.

    Raises
    ------
    StorageError
        When it, or its folder, cannot be made.
    """

    def __init__(self, history: Path, name: str) -> None:
        is_new = not (history.with_suffix("") / name).exists()
        self.path = made_folder_beside(history, name) / "state.json"
        if is_new:  # from now on a file that is missing was lost
            self.save({})
            for folder in (self.path.parent.parent, history.parent):
                self._sync(folder)

    def load(self) -> Mapping[str, Any] | None:
        """The document; None before the first.

        Raises
        ------
        StateLostError
            When it was there once.
        StorageError
            When it cannot be read.
        """
        if not self.path.exists():
            raise StateLostError(f"{self.path} is gone: what it told is forgotten")
        try:
            document = json.loads(read_text(self.path, "state file"))
        except (InputError, ValueError) as error:
            words = f"{self.path} cannot be read: {error}; restore it, or move it away"
            raise StorageError(words) from error
        if not isinstance(document, dict):
            raise StorageError(f"{self.path} holds no document: move it away")
        return document or None

    def save(self, document: Mapping[str, Any]) -> None:
        """Put a document in its place.

        Raises
        ------
        StorageError
            When it cannot be written, or a number is not finite; the one before is still there.
        """
        try:
            write_text(self.path, json.dumps(document, allow_nan=False), durable=True)
        except InputError as error:
            raise StorageError(str(error)) from error
        except ValueError as error:
            raise StorageError(f"{self.path}: {error}") from error

    def _sync(self, folder: Path) -> None:
        try:
            sync_folder(folder)
        except OSError as error:
            raise StorageError(f"{folder} cannot be brought to the disk: {error}") from error
