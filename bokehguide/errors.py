"""The one exception a user's mistake raises."""


class BokehguideError(Exception):
    """A mistake in what the user gave: a file, a field, a value.

    The message is one or two lines that name the file, the field, the value and
    the remedy. The command line prints it without a traceback and exits with 2.
    """
