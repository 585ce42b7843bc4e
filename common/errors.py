"""Errors for users; each message names the fault, the place, and what to do next.

The command line prints the message and ends with `exit_code`, without a traceback. Anything that is
not a `PupperError` is a defect of this project.
"""


class PupperError(Exception):
    """A fault that is reported to the user in one sentence."""

    exit_code = 1


class InputError(PupperError):
    """A file, an option or a value that cannot be used."""

    exit_code = 2


class FileExistsRefusal(InputError):
    """A file exists and `force` is not set."""


class BusError(PupperError):
    """A servo bus failed."""


class MissingDevice(BusError):
    """There is no device of the name that was given."""

    exit_code = 2


class SafetyStop(BusError):
    """The robot was stopped to prevent harm."""
