"""Errors that a user can put right."""


class UserError(Exception):
    """Something that the user can put right; the message is one line that says what, where and how."""
