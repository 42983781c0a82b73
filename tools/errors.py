"""What a command tells its user in one line before it ends with exit code 2."""


class TeamError(Exception):
    """The work can't go on, and the message says what was found, what was needed and where."""


class DataError(TeamError):
    """A file or a folder is not what it should be; the message starts with its path."""
