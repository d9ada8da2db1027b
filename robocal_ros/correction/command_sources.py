"""Commands must come from one source at a time, and a stream that breaks off is told."""

import math

from rclpy.subscription import Subscription


class CommandSources:
    """Tells when one kind of command comes from several sources at once.

    A message does not tell who sent it. So commands that follow each other within a short time,
    while their topic has several publishers or on several topics, count as commands of several
    sources, and none of them is believed: the publishers that merely wait cannot be told apart.

    Parameters
    ----------
    at_once_s : the short time.

    Attributes
    ----------
    inputs : the subscriptions by topic.
    """

    def __init__(self, at_once_s: float) -> None:
        self.inputs: dict[str, Subscription] = {}
        self._at_once_s = at_once_s
        self._topic = ""
        self._heard_s = -math.inf
        self._rivals = ""
        self._rivals_s = -math.inf
        self._gone = ""

    def go_on(self, topic: str, now_s: float) -> bool:
        """Whether a command now plainly follows others of one source; it is not noted."""
        follows = topic == self._topic and now_s - self._heard_s <= self._at_once_s
        alone = follows and self.inputs[topic].get_publisher_count() <= 1
        return alone and not self._rivals_at(now_s)

    def hear(self, topic: str, now_s: float) -> str:
        """Note a command; why it must not be acted on, empty when it may."""
        last, before_s = self._topic, self._heard_s
        self._topic, self._heard_s, self._gone = topic, now_s, ""
        if now_s - before_s <= self._at_once_s:
            if topic != last:
                self._name(f"commands come on {last} and {topic} at once: stop one of them", now_s)
            elif (count := self.inputs[topic].get_publisher_count()) > 1:
                self._name(f"{topic} has {count} publishers: stop all but one", now_s)
        return self._rivals_at(now_s)

    def _name(self, rivals: str, now_s: float) -> None:
        self._rivals, self._rivals_s = rivals, now_s

    def _rivals_at(self, now_s: float) -> str:
        return self._rivals if now_s - self._rivals_s <= self._at_once_s else ""

    def look(self) -> None:
        """Notice that the publisher of a stream has gone; to be called now and then."""
        if self._topic and not self.inputs[self._topic].get_publisher_count():
            self._gone = f"nobody publishes {self._topic} any more"

    def words(self, now_s: float) -> str:
        """What is wrong; empty when all is well."""
        return self._rivals_at(now_s) or self._gone
