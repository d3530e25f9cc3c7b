"""The two errors that a user can meet: one line each, and an exit code on the command line."""

from __future__ import annotations

_SHOWN = 60


class InputError(Exception):
    """Bad input or usage: a file, a key, a setting, an option.  Exit code 2.

    The message is one line that names the file, the key and what was expected; line breaks of names
    in files become spaces.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))


class DeviceError(Exception):
    """The device or the run failed.  Exit code 1.  The message says what to do about it."""


class NoRoomError(DeviceError):
    """The device has no room for a buffer."""


def shown(value: object) -> str:
    """Return how a message shows what the user gave: on one line, shortened."""
    if isinstance(value, dict):
        return "a table"
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print integers of more than 4,300 digits
        return "a huge integer"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
