"""Transforms onto ``/tf_static``, where this machine has its message."""

from collections.abc import Callable, Sequence
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile

from robocal_ros.ros import qos


class StaticTf:
    """Publisher of a node's static transforms.

    Parameters
    ----------
    add : creates a publisher.

    Attributes
    ----------
    missing : why nothing can be published on this machine; empty when it can.
    """

    def __init__(self, add: Callable[[type, str, QoSProfile], Any]) -> None:
        self._publisher: Any = None
        self.missing = ""
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.missing = "no /tf_static: tf2_msgs is missing (apt install ros-jazzy-tf2-msgs)"
        else:
            self._message = TFMessage
            self._publisher = add(TFMessage, "/tf_static", qos.LATCHED)

    def publish(self, transforms: Sequence[TransformStamped]) -> None:
        """Publish these; none: late subscribers get no transform."""
        if self._publisher is not None:
            self._publisher.publish(self._message(transforms=list(transforms)))
