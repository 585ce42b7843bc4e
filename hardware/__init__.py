"""Move real servos safely and read them honestly."""

from hardware.bus import BusSample, Sent, ServoBus

__all__ = ["BusSample", "Sent", "ServoBus"]
