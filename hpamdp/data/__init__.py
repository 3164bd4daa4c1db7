"""Recordings to learn from, and ways to other programs."""


class DataError(ValueError):
    """A data set cannot be fetched, read or written, or its contents are wrong. The message is one line."""
