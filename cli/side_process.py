"""A process beside a loop that moves or reads servos, which takes messages and may be slow.

The loop never waits for it: a message for which there is no space is dropped.
"""

from __future__ import annotations

import select
import socket
import subprocess
import sys

from pupper_sysid.common.errors import InputError

LONGEST_MESSAGE = 65536


class SideProcess:
    """A module in a process of its own, behind a socket whose descriptor is its argument.

    Its reading end ends with this process, however that ends.
    """

    def __init__(self, module: str):
        self.here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            self.process = subprocess.Popen(
                # -P: a file in the user's folder, such as json.py, must not stand in for a module
                [sys.executable, "-P", "-m", module, str(there.fileno())],
                pass_fds=[there.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            )  # fmt: skip
        self.here.setblocking(False)

    def send(self, message: bytes, within_s: float = 0.0) -> bool:
        """Hand over a message, at most `LONGEST_MESSAGE`; whether it was taken.

        For `within_s` space is awaited.
        """
        try:
            if within_s:
                select.select([], [self.here], [], within_s)
            self.here.send(message)
        except OSError:  # behind, or ended: the loop goes on
            return False
        return True

    def answer(self, within_s: float) -> bytes:
        """A message of the process; empty if it ended."""
        if not select.select([self.here], [], [], within_s)[0]:
            raise InputError(
                f"A helping process did not answer within {within_s:.0f} s. Check the machine's "
                "load and memory, then try again."
            )
        try:
            return self.here.recv(LONGEST_MESSAGE)
        except OSError:
            return b""

    def end(self, within_s: float) -> bool:
        """Say that nothing follows, and wait; whether the process ended by itself."""
        self.here.close()
        try:
            self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return False
        return True
