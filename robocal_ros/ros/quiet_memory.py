"""Garbage collection that waits until no message does.

Python looks for garbage when so many objects were made, which is in the middle of a callback, and
now and then through all objects: tens of milliseconds for a node with its libraries. Here what the
start made is never looked at again, and the little rest between callbacks.
"""

import gc


class QuietMemory:
    """Turns automatic collection off, until `end`; `look` takes its place."""

    def __init__(self) -> None:
        gc.collect()
        gc.freeze()
        gc.disable()

    def look(self) -> None:
        """Collect what was made since the start; to be called between callbacks, now and then."""
        gc.collect()

    def end(self) -> None:
        """Collect as Python does."""
        gc.unfreeze()
        gc.enable()
