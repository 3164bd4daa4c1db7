"""The error that the data modules raise."""


class DataError(ValueError):
    """A data set cannot be fetched, read or written, or its contents are wrong. The message is one line."""
