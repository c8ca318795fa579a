"""Rules of the house that a linter does not know."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from sms_jobs.archive import Store

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(
    path
    for folder in ("sms_jobs", "workers", "migrations")
    for path in (ROOT / folder).rglob("*.py")
    if "__pycache__" not in path.parts
)
TESTS = sorted(path for path in (ROOT / "tests").rglob("*.py") if "__pycache__" not in path.parts)

LINES_IN_A_FILE = 450  # about 400, and an eighth more before anybody is stopped
LINES_IN_A_FUNCTION = 70  # a tall screen, signature and all, but for the docstring
ARGUMENTS_OF_A_FUNCTION = 10
USED_BY_PEOPLE = {"sms_jobs/lab/__init__.py"}  # in notebooks, as in docs/python.md
USED_BY_TESTS = {"controller"}  # tells what a simulated controller was commanded
KERNELS = {"kernel", "uncounted_kernel", "summing_kernel", "inlined"}


Function = ast.FunctionDef | ast.AsyncFunctionDef


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def name_of(node: ast.AST) -> str:
    """Return the last word of what an expression names: `subject` of `job.subject`."""
    return ast.unparse(node).rpartition(".")[2]


def module_name(path: Path) -> str:
    """Return the name that a module is imported by."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    inside = parts if parts[0] == "sms_jobs" else ("sms_jobs", *parts)
    return ".".join(inside[:-1] if inside[-1] == "__init__" else inside)


def imported_names(tree: ast.AST) -> Iterator[str]:
    """Yield what a module may import: modules, and names of modules, wherever in it that stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def functions(tree: ast.AST) -> Iterator[Function]:
    """Yield all functions, those of classes and of functions too."""
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def lines_of(node: Function | ast.stmt) -> int:
    """Return over how many lines something goes, without decorators."""
    return (node.end_lineno or node.lineno) - node.lineno + 1


def arguments_of(function: Function) -> list[ast.arg]:
    """Return all arguments, `self` as well."""
    args = function.args
    rest = [one for one in (args.vararg, args.kwarg) if one is not None]
    return [*args.posonlyargs, *args.args, *args.kwonlyargs, *rest]


def is_kernel(function: Function) -> bool:
    """Say whether a function is compiled.

    A kernel is handed arrays and numbers one by one: what bundles of them cost stands at `inlined`.
    """
    return any(isinstance(one, ast.Name) and one.id in KERNELS for one in function.decorator_list)


def takes_options(function: Function) -> bool:
    """Say whether the arguments are what a person may choose: of a command (--home), or of an address.

    Such a function is called with names, by the command line or the server alone, and every argument is an
    option that is documented where people look for it.
    """
    homes = (one.annotation for one in arguments_of(function) if one.arg == "home")
    if any(isinstance(one, ast.Name) and one.id == "Home" for one in homes):
        return True
    calls = (one.func for one in function.decorator_list if isinstance(one, ast.Call))
    return any(ast.unparse(one) == "ROUTES.offer" for one in calls)


def is_entered(node: ast.stmt) -> bool:
    """Say whether a decorator enters what it stands over somewhere: a command, an address, a validator."""
    calls = (one.func for one in getattr(node, "decorator_list", ()) if isinstance(one, ast.Call))
    return not {ast.unparse(one) for one in calls} <= {"dataclass", "use_case"}


def uses(tree: ast.AST) -> Iterator[str]:
    """Yield the names that are read, attributes, and texts that may be names, as of a table of commands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def definitions(tree: ast.Module) -> Iterator[tuple[str, ast.stmt, set[str]]]:
    """Yield what is to be used: functions, classes, constants, and methods with the bases of their class."""
    for node in tree.body:
        if isinstance(node, Function | ast.ClassDef):
            yield node.name, node, set()
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from ((one.id, node, set()) for one in targets if isinstance(one, ast.Name))
        if isinstance(node, ast.ClassDef):
            bases = {ast.unparse(base).partition("[")[0] for base in node.bases}
            yield from ((one.name, one, bases) for one in node.body if isinstance(one, Function))


def packages(lock: str) -> dict[str, set[str]]:
    """Return the versions of each package of a lock; platforms may differ."""
    found: dict[str, set[str]] = {}
    for name, version in re.findall(
        r"^([A-Za-z0-9._-]+)(?:\[[^\]]*\])?==([^ ;\\]+)", (ROOT / lock).read_text(), re.MULTILINE
    ):
        found.setdefault(name.lower(), set()).add(version)
    return found


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_a_module_fits_in_the_head(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    if "versions" in path.parts:
        return  # a migration lists tables, one after the other
    assert len(text.splitlines()) <= LINES_IN_A_FILE
    for function in functions(ast.parse(text)):
        lines = lines_of(function)
        if ast.get_docstring(function):
            lines -= lines_of(function.body[0])
        assert lines <= LINES_IN_A_FUNCTION, f"{function.name} has {lines} lines"


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_what_a_function_takes_fits_in_the_head(path: Path) -> None:
    for function in functions(ast.parse(path.read_text(encoding="utf-8"))):
        if not (is_kernel(function) or takes_options(function)):
            count = len(arguments_of(function))
            assert count <= ARGUMENTS_OF_A_FUNCTION, f"{function.name} takes {count} arguments"


def test_no_module_needs_one_that_needs_it() -> None:
    # An import within a function, or for types alone, hides a circle from Python, not from the reader.
    modules = {module_name(path): path for path in SOURCES}
    graph = {}
    for name, path in modules.items():
        named = imported_names(ast.parse(path.read_text(encoding="utf-8")))
        graph[name] = {one if one in modules else one.rpartition(".")[0] for one in named} & modules.keys()
    TopologicalSorter({name: needed - {name} for name, needed in graph.items()}).prepare()


def test_nobody_keeps_what_nobody_uses() -> None:
    # Told by names alone: what shares its name with something that is used is not found, and nothing is
    # found that is used.
    counts: Counter[str] = Counter()
    classes = {"Protocol", "Generic", "ABC"}
    defined: list[tuple[str, str, int, set[str]]] = []
    for path in SOURCES + [one for one in TESTS if "support" in one.parts or one.name == "conftest.py"]:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        counts.update(uses(tree))
        classes |= {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
        if path in SOURCES and "versions" not in path.parts and relative(path) not in USED_BY_PEOPLE:
            for name, node, bases in definitions(tree):
                if not (name.startswith("__") or name in USED_BY_TESTS or is_entered(node)):
                    own = sum(one == name for one in uses(node))
                    defined.append((relative(path), name, own, bases))
    # Other packages call the methods that a class of ours has from them.
    assert [f"{of}: {n}" for of, n, own, bases in defined if counts[n] <= own and bases <= classes] == []


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_nothing_is_left_for_later(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"\b(TODO|FIXME|XXX|HACK)\b", text)
    assert "NotImplementedError" not in text


def test_nobody_goes_around_the_archive() -> None:
    # Who is given a folder may open it as a store: the settings, a backup, somebody's files, a benchmark.
    opening = {
        f"sms_jobs/{name}.py" for name in ("bootstrap", "jobs/keeping/backups", "jobs/portable/unpacking")
    }
    stores = {store.__name__ for store in Store.__subclasses__()}
    opened, asked = set(), []
    for path in SOURCES:
        if path.parent.name == "archive" or "bench" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Name) and node.id in stores:
                opened.add(relative(path))
            if isinstance(node, ast.Attribute) and node.attr == "store":
                asked.append(f"{relative(path)}:{node.lineno}")
    assert opened == opening
    assert asked == []


def test_what_is_sealed_or_withdrawn_passes_the_repository() -> None:
    ways = {"seal_dataset", "seal_document", "discard"}
    found = set()
    for path in (ROOT / "sms_jobs").rglob("*.py"):
        if {"archive", "bench"} & set(path.parts):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and node.attr in ways and name_of(node.value) == "archive":
                found.add(relative(path))
    assert found == {"sms_jobs/jobs/archiving/repository.py"}


def test_a_subject_is_taken_apart_in_one_place() -> None:
    cuts = {"split", "rsplit", "partition", "rpartition", "replace", "count", "startswith", "endswith"}
    in_pages = [path for path in (ROOT / "sms_jobs" / "web").rglob("*") if path.suffix in (".html", ".js")]
    cut = re.compile(rf"\bsubject\.({'|'.join(sorted(cuts))})\(")
    found = [relative(path) for path in in_pages if cut.search(path.read_text(encoding="utf-8"))]
    for path in SOURCES:
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        asked = [node for node in nodes if isinstance(node, ast.Attribute) and node.attr in cuts]
        lines = [node.lineno for node in asked if name_of(node.value) == "subject"]
        found += [f"{relative(path)}:{line}" for line in lines]
    assert found == []


def test_records_are_read_by_their_products() -> None:
    found = []
    for path in SOURCES:
        if "bench" in path.parts:
            continue  # measures the archive with records of its own
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            named = isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".read") and node.args
            if named and isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str):
                found.append(f"{relative(path)}:{node.lineno}")
    assert found == []


def test_names_say_what_is_inside() -> None:
    vague = {"utils", "util", "helpers", "helper", "manager", "managers", "common", "misc", "data", "process"}
    named_by_a_command = ROOT / "sms_jobs" / "cli"  # `sms data`
    found = [p for p in SOURCES if {p.stem, p.parent.name} & vague and p.parent != named_by_a_command]
    assert [relative(p) for p in found] == []


def test_test_files_have_names_of_their_own() -> None:
    # Reports and selections name a test by its file.
    counts = Counter(p.name for p in TESTS if p.name not in ("conftest.py", "__init__.py"))
    assert [name for name, count in counts.items() if count > 1] == []


@pytest.mark.parametrize("lock", ["requirements.lock", "requirements-test.lock"])
def test_a_lock_is_exact_and_belongs_to_no_machine(lock: str) -> None:
    text = (ROOT / lock).read_text(encoding="utf-8")
    assert "://" not in text
    assert "file:" not in text
    assert "-i " not in text
    requirements = text.replace("\\\n", " ").splitlines()
    assert requirements
    for requirement in requirements:
        assert "==" in requirement
        assert "--hash=sha256:" in requirement


def test_tests_run_what_users_run() -> None:
    runtime, test = packages("requirements.lock"), packages("requirements-test.lock")
    assert {name: test.get(name) for name in runtime} == runtime


def test_every_declared_dependency_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]

    def names(requirements: list[str]) -> set[str]:
        return {re.split(r"[\[<>=~! ;]", r)[0].lower() for r in requirements}

    # Whoever sets up a grown installation, or a rig with a projector, does it by the same commands.
    set_up = project["dependencies"] + extras["build"] + extras["postgresql"] + extras["projector"]
    assert names(set_up) <= packages("requirements.lock").keys()
    assert names(extras["test"]) <= packages("requirements-test.lock").keys()


def test_every_imported_package_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    requirements = [*project["dependencies"]]
    for extra in ("notebook", "openid", "parquet", "postgresql", "projector", "genicam"):
        requirements += extras[extra]
    declared = {re.split(r"[\[<>=~! ;]", r)[0].lower().replace("-", "_") for r in requirements}
    # Packages that are imported under another name, or that come with one that is declared.
    declared |= {"cv2", "PIL", "serial", "kombu", "pydantic_core", "click", "pygame", "genicam", "argon2"}
    imported = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                imported.add((node.module or "").split(".")[0])
    assert imported - sys.stdlib_module_names - declared - {"sms_jobs"} == set()


@pytest.mark.parametrize("script", sorted((ROOT / "ops").glob("*.sh")), ids=relative)
def test_a_script_runs_on_the_bash_of_macos(script: Path) -> None:
    # Bash 3.2 has no associative arrays, no mapfile, no ${x,,} and no &>>.
    text = script.read_text(encoding="utf-8")
    assert not re.search(r"declare -A|mapfile|readarray|\$\{\w+(,,|\^\^)\}|&>>|\|&", text)
