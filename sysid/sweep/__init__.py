"""Excitations, the recorder, and resumption of a recording."""
