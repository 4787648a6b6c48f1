"""The share of the computer that a live drive takes: cores and priority."""

from __future__ import annotations

import os

from mapvote.core.types import MapvoteError


def limit_process(cores: int | None = None, nice: int | None = None) -> None:
    """Hold this process and its threads to so many of the cores that it may use, and lower its priority by ``nice``.

    Call it before threads are started: they inherit both. MapvoteError if the system has fewer cores or refuses.
    """
    if cores is not None:
        if not hasattr(os, "sched_setaffinity"):
            raise MapvoteError("--threads: this system cannot hold a process to cores; leave it out")
        allowed = sorted(os.sched_getaffinity(0))
        if cores > len(allowed):
            raise MapvoteError(f"--threads {cores}: only {len(allowed)} cores may be used; give no more")
        os.sched_setaffinity(0, allowed[-cores:])  # the first core serves most interrupts
    if nice is not None:
        try:
            os.nice(nice)
        except OSError as error:
            raise MapvoteError(
                f"--nice {nice}: {error.strerror}; a higher priority needs the right CAP_SYS_NICE, for example "
                "Nice= in the systemd unit"
            ) from error
