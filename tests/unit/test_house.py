"""Rules of the house that a linter does not know."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
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
CUTS = {"split", "rsplit", "partition", "rpartition", "replace", "count", "startswith", "endswith"}
KERNELS = {"kernel", "uncounted_kernel", "uncounted_summing_kernel", "summing_kernel", "inlined"}


Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Source:
    """A module: its text, its tree and all nodes of that."""

    path: Path
    text: str
    tree: ast.Module
    nodes: list[ast.AST]

    @property
    def name(self) -> str:
        """Its path in the checkout."""
        return relative(self.path)


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


def imported_names(source: Source) -> Iterator[str]:
    """Yield what a module may import: modules, and names of modules, wherever in it that stands."""
    for node in source.nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def functions(source: Source) -> Iterator[Function]:
    """Yield all functions, those of classes and of functions too."""
    return (node for node in source.nodes if isinstance(node, Function))


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


def uses(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the names that are read, attributes, and texts that may be names, as of a table of commands."""
    for node in nodes:
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


def what_is_too_long(source: Source) -> Iterator[str]:
    if "versions" in source.path.parts:
        return  # a migration lists tables, one after the other
    count = len(source.text.splitlines())
    if count > LINES_IN_A_FILE:
        yield f"{source.name} has {count} lines"
    for function in functions(source):
        lines = lines_of(function)
        if ast.get_docstring(function):
            lines -= lines_of(function.body[0])
        if lines > LINES_IN_A_FUNCTION:
            yield f"{source.name}: {function.name} has {lines} lines"


def what_takes_too_much(source: Source) -> Iterator[str]:
    for function in functions(source):
        count = len(arguments_of(function))
        if count > ARGUMENTS_OF_A_FUNCTION and not (is_kernel(function) or takes_options(function)):
            yield f"{source.name}: {function.name} takes {count} arguments"


def what_is_left_for_later(source: Source) -> Iterator[str]:
    for found in re.findall(r"\b(?:TODO|FIXME|XXX|HACK)\b|NotImplementedError", source.text):
        yield f"{source.name}: {found}"


def stores_opened(source: Source) -> Iterator[str]:
    stores = {store.__name__ for store in Store.__subclasses__()}
    if any(isinstance(node, ast.Name) and node.id in stores for node in around_the_archive(source)):
        yield source.name


def stores_asked_for(source: Source) -> Iterator[str]:
    for node in around_the_archive(source):
        if isinstance(node, ast.Attribute) and node.attr == "store":
            yield f"{source.name}:{node.lineno}"


def around_the_archive(source: Source) -> list[ast.AST]:
    inside = source.path.parent.name == "archive" or "bench" in source.path.parts
    return [] if inside else source.nodes


def what_seals_or_withdraws(source: Source) -> Iterator[str]:
    if {"archive", "bench"} & set(source.path.parts):
        return
    ways = {"seal_dataset", "seal_document", "discard"}
    asked = (node for node in source.nodes if isinstance(node, ast.Attribute) and node.attr in ways)
    if any(name_of(node.value) == "archive" for node in asked):
        yield source.name


def what_takes_subjects_apart(source: Source) -> Iterator[str]:
    for node in source.nodes:
        if isinstance(node, ast.Attribute) and node.attr in CUTS and name_of(node.value) == "subject":
            yield f"{source.name}:{node.lineno}"


def what_reads_by_name(source: Source) -> Iterator[str]:
    if "bench" in source.path.parts:
        return  # measures the archive with records of its own
    for node in source.nodes:
        named = isinstance(node, ast.Call) and node.args and ast.unparse(node.func).endswith(".read")
        if named and isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str):
            yield f"{source.name}:{node.lineno}"


def what_only_looks_frozen(source: Source) -> Iterator[str]:
    """Yield frozen classes that begin with an empty list, dict or set of their own, to be filled later."""
    for node in source.nodes:
        if not isinstance(node, ast.ClassDef):
            continue
        frozen = "dataclass(frozen=True)" in map(ast.unparse, node.decorator_list)
        for one in node.body if frozen else ():
            if re.search(r"default_factory=(list|dict|set), init=False", ast.unparse(one)):
                yield f"{source.name}: {node.name}"


Rule = Callable[[Source], Iterator[str]]
RULES: tuple[Rule, ...] = (
    imported_names,
    what_is_too_long,
    what_takes_too_much,
    what_is_left_for_later,
    stores_opened,
    stores_asked_for,
    what_seals_or_withdraws,
    what_takes_subjects_apart,
    what_reads_by_name,
    what_only_looks_frozen,
)


@dataclass(frozen=True)
class Reading:
    """What one reading of every module has found, since reading them takes longer than judging them.

    `found` has what a rule yields for each module; `used` how often each name is used, `classes` those of the
    program, and `defined` what is to be used: its file, its name, how often it names itself, and bases.
    """

    found: dict[Rule, dict[Path, list[str]]]
    used: Counter[str]
    classes: set[str]
    defined: list[tuple[str, str, int, set[str]]]

    def all_of(self, rule: Rule) -> list[str]:
        """Return what a rule yields for all modules."""
        return [one for each in self.found[rule].values() for one in each]


@cache
def reading() -> Reading:
    read = Reading({rule: {} for rule in RULES}, Counter(), {"Protocol", "Generic", "ABC"}, [])
    for path in SOURCES + [one for one in TESTS if "support" in one.parts or one.name == "conftest.py"]:
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        source = Source(path, text, tree, list(ast.walk(tree)))
        read.used.update(uses(source.nodes))
        read.classes.update(node.name for node in source.nodes if isinstance(node, ast.ClassDef))
        if "tests" in path.relative_to(ROOT).parts:
            continue
        for rule in RULES:
            read.found[rule][path] = list(rule(source))
        if "versions" not in path.parts and source.name not in USED_BY_PEOPLE:
            for name, node, bases in definitions(tree):
                if not (name.startswith("__") or name in USED_BY_TESTS or is_entered(node)):
                    own = sum(one == name for one in uses(ast.walk(node)))
                    read.defined.append((source.name, name, own, bases))
    return read


def test_a_module_fits_in_the_head() -> None:
    assert reading().all_of(what_is_too_long) == []


def test_what_is_frozen_keeps_nothing_that_changes() -> None:
    assert reading().all_of(what_only_looks_frozen) == []


def test_what_a_function_takes_fits_in_the_head() -> None:
    assert reading().all_of(what_takes_too_much) == []


def test_what_is_installed_for_the_tests_is_not_left_out_silently() -> None:
    # Where CI=true, support.missing fails what would be skipped elsewhere.
    def skips(path: Path) -> Iterator[str]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and name_of(node.func) == "skip"
                and "ops/test.sh" in ast.unparse(node)
            ):
                yield f"{relative(path)}:{node.lineno}"

    assert [place for path in TESTS for place in skips(path)] == []


def test_no_module_needs_one_that_needs_it() -> None:
    # An import within a function, or for types alone, hides a circle from Python, not from the reader.
    modules = {module_name(path): path for path in SOURCES}
    graph = {}
    for name, path in modules.items():
        named = reading().found[imported_names][path]
        graph[name] = {one if one in modules else one.rpartition(".")[0] for one in named} & modules.keys()
    TopologicalSorter({name: needed - {name} for name, needed in graph.items()}).prepare()


def test_nobody_keeps_what_nobody_uses() -> None:
    # Told by names alone: what shares its name with something that is used is not found, and nothing is
    # found that is used.
    used, classes = reading().used, reading().classes
    # Other packages call the methods that a class of ours has from them.
    unused = [f"{of}: {n}" for of, n, own, bases in reading().defined if used[n] <= own and bases <= classes]
    assert unused == []


def test_nothing_is_left_for_later() -> None:
    assert reading().all_of(what_is_left_for_later) == []


def test_nobody_goes_around_the_archive() -> None:
    # Who is given a folder may open it as a store: the settings, a backup, somebody's files, a benchmark.
    opening = {
        f"sms_jobs/{name}.py" for name in ("bootstrap", "jobs/keeping/backups", "jobs/portable/unpacking")
    }
    assert set(reading().all_of(stores_opened)) == opening
    assert reading().all_of(stores_asked_for) == []


def test_what_is_sealed_or_withdrawn_passes_the_repository() -> None:
    assert reading().all_of(what_seals_or_withdraws) == ["sms_jobs/jobs/archiving/repository.py"]


def test_a_subject_is_taken_apart_in_one_place() -> None:
    in_pages = [path for path in (ROOT / "sms_jobs" / "web").rglob("*") if path.suffix in (".html", ".js")]
    cut = re.compile(rf"\bsubject\.({'|'.join(sorted(CUTS))})\(")
    found = [relative(path) for path in in_pages if cut.search(path.read_text(encoding="utf-8"))]
    assert found + reading().all_of(what_takes_subjects_apart) == []


def test_records_are_read_by_their_products() -> None:
    assert reading().all_of(what_reads_by_name) == []


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
    imported = {one.split(".")[0] for one in reading().all_of(imported_names)}
    assert imported - sys.stdlib_module_names - declared - {"sms_jobs"} == set()


@pytest.mark.parametrize("script", sorted((ROOT / "ops").glob("*.sh")), ids=relative)
def test_a_script_runs_on_the_bash_of_macos(script: Path) -> None:
    # Bash 3.2 has no associative arrays, no mapfile, no ${x,,} and no &>>.
    text = script.read_text(encoding="utf-8")
    assert not re.search(r"declare -A|mapfile|readarray|\$\{\w+(,,|\^\^)\}|&>>|\|&", text)
