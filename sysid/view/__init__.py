"""Recordings as files of other viewers: Rerun (`.rrd`) and Foxglove (`.mcap`)."""
