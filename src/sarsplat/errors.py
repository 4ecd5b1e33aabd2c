"""The one exception users are meant to read."""


class SarsplatError(Exception):
    """A mistake in the input, told in one sentence: what is wrong, with the value, and what to do.

    The command line prints the message without a traceback and exits with code 2.
    """
