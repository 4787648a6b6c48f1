"""``python -m mapvote``, and the entry point of the ``mapvote`` command."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


def main() -> None:
    """Run the command line. Ctrl-C ends it with one line and exit code 130, also while it still imports."""
    sys.unraisablehook = _interrupt_again
    try:
        from mapvote.cli import run

        run()
    except KeyboardInterrupt:
        print("mapvote: interrupted", file=sys.stderr)
        sys.exit(130)
    finally:
        gc.freeze()  # at its end Python takes apart every cycle, compiled kernels among them: .4 s, and all goes anyway


def _interrupt_again(lost: UnraisableHookArgs) -> None:
    """Send a Ctrl-C once more that came while Python deleted an object: Python drops exceptions there."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        main_thread = threading.main_thread().ident or 0
        soon_s = 0.05  # at once, it would be lost too
        again = threading.Timer(soon_s, signal.pthread_kill, (main_thread, signal.SIGINT))
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(lost)


if __name__ == "__main__":
    main()
