"""Entry point of the command ``flexid`` and of ``python -m flexid_cli``."""

from __future__ import annotations

import os
import signal


def main() -> None:
    """Run the command; Ctrl-C while its modules are imported ends it like one later on."""
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupted)
    from flexid_cli.cli.main import main as command

    signal.signal(signal.SIGINT, usual)
    command()


def _interrupted(*_: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
