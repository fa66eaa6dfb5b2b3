"""Errors that a user can put right."""


class UserError(Exception):
    """Something that the user can put right; the message is one line that says what, where and how."""


class NotFinite(UserError):
    """A loss, a gradient, a parameter or an action of a training is no longer finite; the message names it."""
