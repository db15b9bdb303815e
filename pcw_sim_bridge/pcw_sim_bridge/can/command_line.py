"""What the commands of the CAN part share."""

from __future__ import annotations

import signal


def end_on_signals() -> None:
    """Let SIGTERM end a command as SIGINT does, so that it takes the torque away and closes its files."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
