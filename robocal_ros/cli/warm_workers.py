"""Worker processes that have read their code before there is work for them."""

import signal
from multiprocessing import forkserver

METHOD = "forkserver"
_CODE = [
    "distributed.nanny",
    "distributed.worker",
    "robocal_ros.cli.validating",
    # what a bag needs in the course of things
    "robocal_ros.kinematics.kernels",
    "robocal_ros.ground.mcap_records",
    "robocal_ros.ground.serialized_joints",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_svg",
    "scipy.special",
]


def warm_up() -> None:
    """Let the server of worker processes read the code, beside what this process does meanwhile.

    Workers are its forks, from a process of one thread: they begin at once, where each would
    otherwise import everything anew.
    """
    forkserver.set_forkserver_preload(_CODE)
    # Ctrl-C is for this process alone: it ends the others.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
