"""``python -m mapvote``, and the entry point of the ``mapvote`` command."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line. Ctrl-C ends it with one line and exit code 130, also while it still imports."""
    try:
        from mapvote.cli import run

        run()
    except KeyboardInterrupt:
        print("mapvote: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
