"""From the serialized messages of a topic to what they say: one by one, or joint states in blocks.

A reader takes messages and a range of them, and gives contents with the place of each.
"""

from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.serde.errors import SerdeError
from rosbags.typesys.store import Typestore

from robocal_ros.bags.bag_types import ros_types
from robocal_ros.bags.mcap_files import McapFile
from robocal_ros.bags.messages import Messages
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import JointBlock, joint_sample

if TYPE_CHECKING:
    from robocal_ros.ground.serialized_joints import JointLayout

Decode = Callable[[Messages, int], Any]
Reader = Callable[[Messages, int, int], Iterator[tuple[int, Any]]]

JOINT_STATE = "sensor_msgs/msg/JointState"
MOST_LAYOUTS = 8  # of a topic: a gripper and an arm may take turns
MOST_TOGETHER = 1024  # readings: where all are odd, each is looked for among so many


def message_reader(
    file: McapFile, channel: int, types: Typestore | None, blocks: Collection[str]
) -> Reader:
    """Reader of a channel.

    ``types`` decode its messages; None: they stay bytes. ``blocks``: topics whose joint states
    come in blocks.
    """
    topic, msgtype = file.channels[channel].topic, file.msgtype(channel)
    if types is None:
        return _OneByOne(lambda found, place: bytes(found.data(place)))

    def decode(found: Messages, place: int) -> Any:
        try:
            return types.deserialize_cdr(found.data(place), msgtype)
        except (SerdeError, KeyError) as error:
            raise InputError(
                f"a message of {topic} at {found.log_time_ns[place]} ns is not a {msgtype}: "
                f"{error}",
                file=str(file.path),
            ) from error

    as_defined = types.fielddefs.get(msgtype) == ros_types().fielddefs[JOINT_STATE]
    gathered = topic in blocks and msgtype == JOINT_STATE and as_defined
    return _JointReader(decode) if gathered else _OneByOne(decode)


class _OneByOne:
    """Reader of any topic."""

    def __init__(self, decode: Decode) -> None:
        self._decode = decode

    def __call__(self, found: Messages, start: int, stop: int) -> Iterator[tuple[int, Any]]:
        for place in range(start, stop):
            yield place, self._decode(found, place)


class _JointReader(_OneByOne):
    """Reader of a topic of joint states: as decoded one by one, many times faster.

    What can be used comes in blocks (`JointBlock`), what is odd as messages.
    """

    def __init__(self, decode: Decode) -> None:
        super().__init__(decode)
        self._layouts: list[tuple[JointLayout, tuple[str, ...]]] = []

    def __call__(self, found: Messages, start: int, stop: int) -> Iterator[tuple[int, Any]]:
        while start < stop:
            until = min(stop, start + MOST_TOGETHER)
            block = self._block(found, start, until)
            if block is None and self._learn(found, start):
                block = self._block(found, start, until)
            if block is None:
                yield start, self._decode(found, start)
                start += 1
            else:
                yield start, block
                start += len(block)

    def _block(self, found: Messages, start: int, stop: int) -> JointBlock | None:
        """The readings from ``start`` on that are laid out alike and finite; None without."""
        begin, end = found.begin[start:stop], found.end[start:stop]
        content = np.frombuffer(found.content, dtype=np.uint8)
        for layout, names in self._layouts:
            if len(layout.pattern) != end[0] - begin[0]:
                continue
            stamps, position = layout.gather(content, begin, end)
            finite = np.isfinite(position).all(axis=1)
            count = len(stamps) if finite.all() else int(np.argmin(finite))
            if count:
                return JointBlock(stamps[:count], names, position[:count])
        return None

    def _learn(self, found: Messages, place: int) -> bool:
        """Take the layout of a message, if it is one that can be used."""
        from robocal_ros.ground.serialized_joints import JointLayout

        layout = JointLayout.of(bytes(found.data(place)))
        if layout is None:
            return False
        try:
            sample = joint_sample(self._decode(found, place))
        except InputError:  # said where the message is taken
            return False
        self._layouts.insert(0, (layout, sample.names))
        del self._layouts[MOST_LAYOUTS:]
        return True
