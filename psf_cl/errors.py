"""The two errors that a user can meet: one line each, and an exit code on the command line."""


class InputError(Exception):
    """Bad input or usage: a file, a key, a setting, an option.  Exit code 2.

    The message is one line that names the file, the key and what was expected.
    """


class DeviceError(Exception):
    """The device or the run failed.  Exit code 1.  The message says what to do about it."""
