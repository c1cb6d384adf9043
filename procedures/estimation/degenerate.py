"""The estimators' one complaint."""


class Degenerate(ValueError):
    """The data do not determine what is sought; the message says which condition failed."""
