"""Exceptions with messages for the user: what is wrong, and what to do."""


class MapperError(Exception):
    """Base of all errors that the user can fix; shown without a traceback."""


class ParameterError(MapperError):
    """A parameter is unknown, of the wrong type or out of range."""


class BagError(MapperError):
    """A bag is missing, damaged, or lacks what mapping needs."""


class InputError(MapperError):
    """The messages were read, but no map can be made from them."""


class OutputError(MapperError):
    """A result cannot be written."""


class Cancelled(MapperError):
    """The work was stopped on request; nothing was changed."""


class ClusterError(MapperError):
    """Workers cannot be reached, do not fit each other, or ended too often."""
