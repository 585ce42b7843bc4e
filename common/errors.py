"""The errors a user can meet; each message says what is wrong, where, and what to do next.

The command line prints the message and ends with `exit_code`; a traceback is shown only with
`--debug`. Anything that is not a `PupperError` is a defect of this project.
"""


class PupperError(Exception):
    """Something went wrong that the user should hear about in one sentence."""

    exit_code = 1


class InputError(PupperError):
    """A file, an option or a value the user gave cannot be used."""

    exit_code = 2


class FileExistsRefusal(InputError):
    """A file would have been overwritten without `--force`."""


class BusError(PupperError):
    """The servo bus did not do what it was asked."""


class SafetyStop(BusError):
    """The robot was stopped because going on could have harmed it."""
