"""What goes wrong with human data."""


class HumanDataError(ValueError):
    """A data set that cannot be had, read or written, told in one line."""
