"""A job service with a data archive for optical shape, deformation and strain measurement."""

import os
from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def open(home: str | os.PathLike[str] | None = None) -> Any:  # noqa: A001 - it stands behind the package's name
    """Open a home for a program or a notebook, as a `sms_jobs.lab.Lab`; see docs/python.md.

    Parameters
    ----------
    home
        Its folder; the usual one if it is None.

    Raises
    ------
    ConfigurationError
        There is no home, or its catalogue is older than this version needs.
    """
    # By its name: every layer imports this package, and none of them the interface above it.
    return import_module("sms_jobs.lab").open_home(home)


def connect(url: str, token: str | None = None) -> Any:
    """Open the home that `sms serve` offers at an address, as a `sms_jobs.lab.Lab`; see docs/python.md.

    Parameters
    ----------
    url
        Like https://lab.example.org:8470; http only of this machine.
    token
        Of a person, as `sms person token` gives it; none where nobody has a name yet.

    Raises
    ------
    InvalidInput
        It is no such address, or no token.
    NotAllowed
        The token is nobody's.
    ServerUnreachable
        The server does not answer.
    """
    return import_module("sms_jobs.lab").connect(url, token)
