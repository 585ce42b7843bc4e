"""Move real servos safely and read them honestly."""

from hardware.bus import BusSample, ServoBus

__all__ = ["BusSample", "ServoBus"]
