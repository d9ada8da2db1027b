# SPDX-License-Identifier: Apache-2.0
"""What processes of tests need, read once by the one that they are forked from (`forked`)."""

import gc
import inspect
import os
import sys
from contextlib import suppress
from importlib import import_module

# A look for garbage amid so many new objects, which all stay, takes a third of the time; and in a
# fork it would touch, and so copy, all of them: a stall of 0.1 s amid a motion.
gc.disable()
# The command first: it sets the threads of what NumPy loads.
READ = ["robocal_ros.cli.main", "rich.table", "scipy.optimize", "scipy.spatial.transform"]
# Commands load these when they are called: 0.4 s of a core each time, most of it scipy.signal.
READ += [f"robocal_ros.{name}" for name in ("hand_eye.solve", "hand_eye.cli", "thermal.cli")]
READ += [f"robocal_ros.{name}" for name in ("tool.cli", "cli.replay", "cli.identify")]
# What forks are to do is in these; the modules that hold it are read with all that they import.
READ += ["forked", "command"]
NODES = ["thermal.node", "tool.node", "hand_eye.node", "correction.node", "maintenance.node"]
NODES += ["cell_sim.node", "bags.replay_node", "bags.recorder_node", "adapter.node", "plc.node"]
if "ROS_DOMAIN_ID" in os.environ:
    READ += [f"robocal_ros.{name}" for name in NODES]
    READ += ["rclpy.experimental.events_executor", "service_msgs.msg"]
    READ += ["type_description_interfaces.msg"]
for name in READ:
    with suppress(ImportError):  # rclpy is not everywhere
        import_module(name)

if "rclpy" in sys.modules:
    from rosidl_generator_py import import_type_support

    # What messages begin with, parsers among it, takes half of a node's start.
    for name in [n for n in sys.modules if n.endswith(("_msgs", "_srvs", "_interfaces"))]:
        import_type_support(name)
    # A third: the first line of rclpy's log looks through the files of all modules.
    inspect.getframeinfo(inspect.currentframe())

import numpy as np  # noqa: E402

from robocal_ros.kinematics.robots import load_robot  # noqa: E402

_ur10 = load_robot("ur10")
_ur10.fk(np.zeros((2, _ur10.n)))  # loads the compiled kernels
gc.freeze()
gc.enable()
