"""The two kinds of failure a user can meet."""

from __future__ import annotations


class InputError(ValueError):
    """Something the user gave is wrong: names the field, its value, the rule and the mend.

    Commands print the message as one paragraph and exit with status 2.
    """


class SolverError(ArithmeticError):
    """A computation left its valid range: names the quantity, its value and the limit."""
