"""Messages as they lie in the bytes of a bag."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Places = NDArray[np.int64]


class Messages(NamedTuple):
    """Messages (k,) in the bytes that they came from.

    Attributes
    ----------
    content : the bytes.
    log_time_ns : when each was recorded.
    channel : its number.
    begin, end : where its data lies.
    """

    content: memoryview
    log_time_ns: Places
    channel: Places
    begin: Places
    end: Places

    def data(self, place: int) -> memoryview:
        """A message's data."""
        return self.content[self.begin[place] : self.end[place]]

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Messages":
        """Return those at ``rows``."""
        return Messages(self.content, *(column[rows] for column in self[1:]))

    @classmethod
    def among(cls, content: memoryview) -> "Messages":
        """Messages among MCAP records, as they are stored.

        Raises
        ------
        ValueError
            When the bytes are not whole records.
        """
        from robocal_ros.ground.mcap_records import find_messages

        return cls(content, *find_messages(content))
