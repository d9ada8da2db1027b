"""Small documents of a robot beside its history: whole or not at all, a power cut included."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robocal_ros.ground.errors import InputError, StateLostError, StorageError
from robocal_ros.ground.files import (
    draft_beside,
    made_folder_beside,
    read_text,
    sync_folder,
    write_text,
)

STATE = "state.json"


class StateFile:
    """One JSON document, ``<serial>/<name>/state.json`` beside a history; empty at first.

    Raises
    ------
    StorageError
        When it, or its folder, cannot be made.
    """

    def __init__(self, history: Path, name: str) -> None:
        folder = history.with_suffix("") / name
        self.path = folder / STATE
        if not folder.exists():  # from then on a file that is missing was lost
            self._begin(history, folder)

    def _begin(self, history: Path, folder: Path) -> None:
        """Make the folder with the file in it, unless another does so first."""
        draft = made_folder_beside(history, draft_beside(folder).name)
        try:
            write_text(draft / STATE, "{}", durable=True)
            draft.rename(folder)
        except InputError as error:
            raise StorageError(str(error)) from error
        except OSError as error:
            if not folder.exists():
                raise StorageError(f"{folder} cannot be made: {error.strerror}") from error
        finally:
            if draft.exists():
                (draft / STATE).unlink(missing_ok=True)
                draft.rmdir()
        for parent in (folder.parent, history.parent):
            self._sync(parent)

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
