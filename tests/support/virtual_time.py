"""Time that passes only where a test says so."""


class VirtualTime:
    """Clock of a bus or a loop of a test [s]."""

    time = 0.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, time_s: float) -> None:
        self.time = max(self.time, time_s)
