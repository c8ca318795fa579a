"""Finds what the modules of a package declare, so that adding one more touches one file."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from sms_jobs.errors import InvalidInput, did_you_mean

T = TypeVar("T")


def declared(package: str, constant: str) -> dict[str, Any]:
    """Return the constants of one name in the modules of a package and of those in it, by their `name`.

    Parameters
    ----------
    package
        Its full name.
    constant
        What a module calls its declaration, e.g. KIND; modules without one are left out.
    """
    found = {}
    for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        declaration = getattr(importlib.import_module(module.name), constant, None)
        if declaration is not None:
            found[declaration.name] = declaration
    return dict(sorted(found.items()))


def told_names(package: str, constant: str) -> list[str]:
    """Return the names of what `declared` finds in a package, read off the text of its modules.

    None of them is imported: that can take seconds, and whoever presses Tab does not wait. The name has to
    stand first in the declaration, as a text; a test compares with `declared`.
    """
    declaration = re.compile(rf'^{constant} = \w+\(\s*(?:name=)?"([^"]+)"', re.MULTILINE)
    folders = map(Path, importlib.import_module(package).__path__)
    files = (file for folder in folders for file in folder.rglob("*.py"))
    return sorted(name for file in files for name in declaration.findall(file.read_text("utf-8")))


def chosen(found: Mapping[str, T], name: str, what: str) -> T:
    """Return the declaration of that name; raise `InvalidInput`, naming what there is, if there is none."""
    if name not in found:
        meant = did_you_mean(name, found)
        raise InvalidInput(f"there is no {what} '{name}'; {meant}choose one of {', '.join(found)}")
    return found[name]
