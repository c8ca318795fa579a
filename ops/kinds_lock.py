#!/usr/bin/env python3
"""Keeps ops/kinds.lock: of every job kind its version, and a digest of the source that its numbers come from.

A result is reused while its kind's version is the same, so a change of the source below a kind has to raise
it, or somebody has to say that no number changes:

    .venv/bin/python ops/kinds_lock.py                    what differs
    .venv/bin/python ops/kinds_lock.py --write            note the kinds whose version was raised
    .venv/bin/python ops/kinds_lock.py --same-numbers strain "only names"
                                                          note one whose numbers stay, and why

It writes `sms_jobs/cli/kinds.json`, too: names and summaries of all kinds, for the shell to offer.

The digest covers the kind's module and every module of this project that it needs, however indirectly, but
for comments, docstrings and the modules of NEUTRAL, which carry numbers and make none. A kind whose jobs are
never run again, a recording, has no line: nothing of it is reused.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import sys
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "ops" / "kinds.lock"
OFFERED = ROOT / "sms_jobs" / "cli" / "kinds.json"
NEUTRAL = frozenset(
    {
        "sms_jobs",
        "sms_jobs.discovery",
        "sms_jobs.errors",
        "sms_jobs.kinds",
        "sms_jobs.kinds.kind",
        "sms_jobs.kinds.parameters",
        "sms_jobs.kinds.products",
        "sms_jobs.records.views",
    }
)
BESIDE = frozenset({".js", ".css", ".html", ".json", ".toml"})


@dataclass(frozen=True)
class Locked:
    """What is noted of a kind: with `same_numbers`, why its source could change and its version stay."""

    version: int
    digest: str
    same_numbers: str = ""


@cache
def _tree(module: str) -> ast.Module:
    """Return the code of a module without comments and docstrings; a package is its `__init__`."""
    tree = ast.parse(_path(module).read_text("utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                del node.body[0]
    return tree


def _path(module: str) -> Path:
    path = ROOT.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _declared_for(module: str, graph: grimp.ImportGraph) -> set[str]:
    """Return the modules whose declarations a module asks for by `declared(package, constant)`."""
    found: set[str] = set()
    for call in ast.walk(_tree(module)):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "declared":
            package, constant = (getattr(one, "value", module) for one in call.args)
            within = graph.find_descendants(package)
            found |= {name for name in within if constant in _assigned(name)}
    return found


def _assigned(module: str) -> set[str]:
    """Return the names that a module sets at its top."""
    targets = [
        target for node in _tree(module).body if isinstance(node, ast.Assign) for target in node.targets
    ]
    return {target.id for target in targets if isinstance(target, ast.Name)}


def sources_of(module: str, graph: grimp.ImportGraph) -> list[str]:
    """Return a module and all that it needs, however indirectly, but for what is neutral."""
    known: set[str] = set()
    left = {module}
    while left:
        known |= left
        left = (
            {
                name
                for one in left
                for name in graph.find_modules_directly_imported_by(one) | _declared_for(one, graph)
            }
            - known
            - NEUTRAL
        )
    return sorted(known)


def digest_of(module: str, graph: grimp.ImportGraph) -> str:
    """Return the digest of a module and of all that it needs, with the scripts and styles beside them."""
    hashed = hashlib.sha256()
    names = sources_of(module, graph)
    for name in names:
        hashed.update(f"{name}\n{ast.dump(_tree(name))}\n".encode())
    for folder in sorted({_path(name).parent for name in names}):
        for path in sorted(path for path in folder.iterdir() if path.suffix in BESIDE):
            hashed.update(path.name.encode() + path.read_bytes())
    return hashed.hexdigest()[:16]


def found() -> dict[str, Locked]:
    """Return version and digest of every kind whose results are reused, as the source has them."""
    from sms_jobs.kinds import all_kinds
    from sms_jobs.kinds.kind import never

    graph = grimp.build_graph("sms_jobs")
    return {
        name: Locked(kind.version, digest_of(kind.run.__module__, graph))
        for name, kind in all_kinds().items()
        if kind.repeatable is not never
    }


def locked() -> dict[str, Locked]:
    """Return what was noted."""
    if not LOCK.exists():
        return {}
    return {name: Locked(**entry) for name, entry in tomllib.loads(LOCK.read_text("utf-8")).items()}


def offered() -> str:
    """Return what the shell is to offer, as the kinds have it."""
    from sms_jobs.kinds import all_kinds

    kinds = {name: kind.summary for name, kind in sorted(all_kinds().items())}
    return json.dumps(kinds, indent=1) + "\n"


def complaints(now: dict[str, Locked], noted: dict[str, Locked]) -> list[str]:
    """Return what somebody has to decide, kind by kind."""
    said = []
    for name in sorted(now.keys() | noted.keys()):
        if name not in now:
            said.append(f"nothing of a kind {name} is reused any more: run ops/kinds_lock.py --write")
        elif name not in noted or now[name].version != noted[name].version:
            said.append(f"version {now[name].version} of {name} is not noted: run ops/kinds_lock.py --write")
        elif now[name].digest != noted[name].digest:
            said.append(
                f"the source of {name} has changed and its version, {now[name].version}, has not: "
                "raise it and run ops/kinds_lock.py --write, or, if no number changes, "
                f"ops/kinds_lock.py --same-numbers {name} WHY"
            )
    return said


def updated(now: dict[str, Locked], noted: dict[str, Locked], why: dict[str, str]) -> dict[str, Locked]:
    """Return what is to be noted: raised versions, and the kinds in `why`; the rest stays as it was."""
    entries = {}
    for name, one in sorted(now.items()):
        before = noted.get(name)
        if name in why:
            entries[name] = Locked(one.version, one.digest, why[name])
        elif before is None or before.version != one.version:
            entries[name] = one
        else:
            entries[name] = before
    return entries


def _text(entries: dict[str, Locked]) -> str:
    parts = ["# Written by ops/kinds_lock.py, which says what it is for.\n"]
    for name, one in entries.items():
        parts.append(f'\n[{name}]\nversion = {one.version}\ndigest = "{one.digest}"\n')
        if one.same_numbers:
            quoted = one.same_numbers.replace("\\", "\\\\").replace('"', '\\"')
            parts.append(f'same_numbers = "{quoted}"\n')
    return "".join(parts)


def main() -> int:
    """Compare, and write what is asked for."""
    parser = argparse.ArgumentParser(description="Note the sources of job kinds.")
    parser.add_argument("--write", action="store_true", help="note the kinds whose version was raised")
    parser.add_argument(
        "--same-numbers",
        nargs=2,
        action="append",
        default=[],
        metavar=("KIND", "WHY"),
        help="'all' for every kind",
    )
    given = parser.parse_args()
    now, noted = found(), locked()
    why = dict(given.same_numbers)
    if "all" in why:
        reason = why.pop("all")
        why |= {
            name: reason for name, one in now.items() if name in noted and noted[name].digest != one.digest
        }
    unknown = sorted(why.keys() - now.keys())
    if unknown:
        parser.error(f"nothing of a job kind {unknown[0]} is reused; choose one of {', '.join(now)}")
    if given.write or why:
        noted = updated(now, noted, why)
        LOCK.write_text(_text(noted), encoding="utf-8")
        OFFERED.write_text(offered(), encoding="utf-8")
    said = complaints(now, noted)
    if not OFFERED.exists() or OFFERED.read_text("utf-8") != offered():
        said.append(
            f"{OFFERED.relative_to(ROOT)} has not all kinds as they are: run ops/kinds_lock.py --write"
        )
    sys.stdout.write("".join(f"{line}\n" for line in said))
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
