"""Commands load what they need and no more: told by the modules, not by a clock."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from support.homes import make_home

from sms_jobs.catalogue import schema, tables
from sms_jobs.cli.commands import COMMANDS
from sms_jobs.cli.data import TABLE as DATA

COMMAND_LINE = {
    *("sms_jobs", "typer", "annotated_doc", "shellingham", "typing_extensions"),
    *("pydantic", "pydantic_core", "annotated_types", "typing_inspection", "cython_runtime"),
}
"""Typer, what it needs, and what that needs."""
TABLES = {"rich", "attr", "pygments", "markdown_it", "mdurl"}
CATALOGUE = {"sqlalchemy", "greenlet"}
_SAY = (
    "import sys\n"
    "of_the_interpreter = set(sys.modules)\n"
    "import runpy\n"
    "for words in sys.argv[1:]:\n"
    "    sys.argv = ['sms', *words.split()]\n"
    "    try:\n"
    "        runpy.run_module('sms_jobs.cli.main', run_name='__main__')\n"
    "    except SystemExit as end:\n"
    "        assert not end.code, (words, end.code)\n"
    "    ours = [n for n in set(sys.modules) - of_the_interpreter if n[0] != '_']\n"
    "    ours = [n for n in ours if n.partition('.')[0] not in sys.stdlib_module_names]\n"
    "    print('loaded', *ours, file=sys.stderr)\n"
)
STATUS = {
    "": "bootstrap errors settings",
    "app": "rules",
    "app.home": "service",
    "archive": "archive checking damage folder form layout memory place provenance sealing store",
    "catalogue": "database deeds job_counts people readable renewal schema",
    "catalogue.tables": "base campaigns columns job_counts people workers",
    "cli": "app commands output service waiting",
    "jobs.asking": "standing",
    "jobs.devices": "disks",
    "jobs.recording": "any_plans",
    "records": "job numbers people plain sizes subject texts times views",
    "records.shown": "estimates planned_recordings",
}
"""Modules of ours, by folder, that `sms status` loads where nothing is planned and no job is ahead."""

_COMPLETE = """
import json, os, sys
import sqlalchemy.orm, typer
from sms_jobs import bootstrap
for line in json.loads(sys.argv[1]):
    print(line, end=":", flush=True)
    if os.fork() == 0:
        sys.argv[:] = ["sms"]
        os.environ |= {"_SMS_COMPLETE": "complete_bash", "COMP_WORDS": line}
        os.environ["COMP_CWORD"] = str(len(line.split(" ")) - 1)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        from sms_jobs.cli.main import main
        try:
            main()
        finally:
            os.write(2, " ".join({name.partition(".")[0] for name in sys.modules}).encode() + b"\\n")
            os._exit(0)
    os.wait()
"""
"""Completes each line in a process of its own, forked off one that has loaded what every command needs."""
HEAVY = {"numba", "llvmlite", "scipy", "cv2", "h5py", "alembic", "matplotlib", "pandas", "celery", "fastapi"}


def modules(*commands: str, home: Path | None = None) -> dict[str, set[str]]:
    """Return the modules that are loaded after each command, none of which comes with Python.

    One process runs them all, one after the other: the first that has too many has loaded them.
    """
    done = subprocess.run(
        [sys.executable, "-c", _SAY, *commands],
        capture_output=True,
        text=True,
        check=True,
        stdin=subprocess.DEVNULL,
        env=os.environ | ({} if home is None else {"SMS_HOME": str(home)}),
    )
    said = [line.split()[1:] for line in done.stderr.splitlines() if line.partition(" ")[0] == "loaded"]
    return {words: set(names) for words, names in zip(commands, said, strict=True)}


def loaded(*commands: str, home: Path | None = None) -> dict[str, set[str]]:
    """Return the packages that these modules are of."""
    found = modules(*commands, home=home)
    return {words: {name.partition(".")[0] for name in names} for words, names in found.items()}


def too_many(found: dict[str, set[str]], allowed: set[str]) -> dict[str, set[str]]:
    """Return what commands have loaded beside what they may."""
    return {words: packages - allowed for words, packages in found.items() if packages - allowed}


@cache
def all_loaded() -> dict[str, str]:
    """Return what each command says of itself in one line."""
    return {name: command.load(name).get_short_help_str(300) for name, command in COMMANDS.items()}


def test_looking_around_needs_no_catalogue() -> None:
    assert too_many(loaded("--version", "--help", "data --help"), COMMAND_LINE | TABLES) == {}


ASKING = (
    *("status", "job list", "campaign list", "data find", "data find load_n>1", "data query list"),
    *("data states", "data states load_n>1"),
    *("calibration list", "rig list", "queue list", "lock list", "worker list"),
    *("person list", "audit list", "notify list", "data pins", "run list"),
)


def test_what_only_asks_the_catalogue_loads_nothing_else(home: Path) -> None:
    make_home(home, {})
    assert too_many(loaded(*ASKING, home=home), COMMAND_LINE | TABLES | CATALOGUE) == {}


def test_a_status_loads_what_it_shows(home: Path) -> None:
    make_home(home, {})
    allowed = {f"sms_jobs.{at}.{name}".replace("..", ".") for at in STATUS for name in STATUS[at].split()}
    folders = {name.rpartition(".")[0] for name in allowed} | {"sms_jobs.app", "sms_jobs.jobs"}
    found = {name for name in modules("status", home=home)["status"] if name.startswith("sms_jobs.")}
    assert found <= allowed | folders


def test_what_is_left_out_is_not_checked(home: Path) -> None:
    make_home(home, {})
    asking = [words for words in ASKING if ">" not in words]
    found = modules(*asking, "job list --limit 5", home=home)
    # With which Typer checks values.
    assert [words for words in asking if "typer._adapters" in found[words]] == []
    assert "typer._adapters" in found["job list --limit 5"]


def test_what_asks_some_tables_maps_no_others(home: Path) -> None:
    make_home(home, {})
    asking = ("status", "job list", "campaign list", "data find", "worker list")
    found = modules(*asking, home=home)
    assert [words for words in asking if "sms_jobs.catalogue.tables.every" in found[words]] == []


def test_to_list_jobs_needs_nothing_that_submits_or_waits_for_them(home: Path) -> None:
    make_home(home, {})
    asked, submitted = "job list", "job submit simulate -c plate --dry-run"
    found = modules(asked, submitted, home=home)
    names = (
        "app.work.new_jobs",
        "app.work.waiting",
        "jobs.planning.graph",
        "jobs.planning.estimates",
        "kinds",
    )
    submitting = {f"sms_jobs.{name}" for name in names}
    assert submitting & found[asked] == set()
    assert submitting <= found[submitted]


def test_a_module_of_tables_brings_those_that_its_own_refer_to() -> None:
    alone = (
        "import os, sys\n"
        "from importlib import import_module\n"
        "from sqlalchemy.orm import configure_mappers\n"
        "from sms_jobs.catalogue.tables.base import Table\n"
        "for name in sys.argv[1:]:\n"
        "    if os.fork() == 0:\n"
        "        import_module(f'sms_jobs.catalogue.tables.{name}')\n"
        "        configure_mappers()\n"
        "        print(name, len(Table.metadata.sorted_tables), flush=True)\n"
        "        os._exit(0)\n"
        "    os.wait()\n"
    )
    names = [file.stem for file in Path(tables.__path__[0]).glob("[a-z]*.py")]
    done = subprocess.run([sys.executable, "-c", alone, *names], capture_output=True, text=True, check=True)
    mapped = {name: int(number) for name, number in map(str.split, done.stdout.splitlines())}
    # Where a table referred to one that is not loaded, it could not be sorted, and its process would end.
    assert set(mapped) == set(names), done.stderr
    assert mapped["states"] == 5
    assert mapped["every"] > 30


def test_what_tab_offers_needs_nothing_that_computes(home: Path) -> None:
    make_home(home, {})
    lines = [f"sms {name} -" for name in COMMANDS] + [f"sms data {name} -" for name in DATA]
    lines += [
        "sms ",
        "sms data ",
        "sms import ",
        "sms acquire ",
        "sms job submit ",
        "sms bench ",
        "sms study ",
    ]
    lines += ["sms campaign show ", "sms acquire run plate -s ", "sms job show ", "sms run show "]
    done = subprocess.run(
        [sys.executable, "-c", _COMPLETE, json.dumps(lines)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"SMS_HOME": str(home)},
    )
    found = dict(zip(lines, (set(line.split()) for line in done.stderr.splitlines()), strict=True))
    assert {line: names & HEAVY for line, names in found.items() if names & HEAVY} == {}


def test_schedules_need_no_more_than_what_reads_their_times(home: Path) -> None:
    make_home(home, {})
    found = loaded("schedule list", home=home)
    assert too_many(found, COMMAND_LINE | TABLES | CATALOGUE | {"cronsim"}) == {}


def test_jobs_let_what_asks_for_them_load_no_more(home: Path) -> None:
    make_home(home, {})
    loaded("job submit simulate pipeline -c plate", home=home)
    found = loaded("job list", "queue list", "campaign list", "data find", home=home)
    assert too_many(found, COMMAND_LINE | TABLES | CATALOGUE) == {}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_shown_of_a_command_is_what_it_says_itself(name: str) -> None:
    assert all_loaded()[name] == COMMANDS[name].help


def test_the_revisions_that_are_read_off_the_files_are_those_of_the_migrations() -> None:
    from alembic.script import ScriptDirectory

    scripts = ScriptDirectory.from_config(schema.configuration())
    assert [script.revision for script in scripts.walk_revisions()] == list(reversed(schema.revisions()))


def test_a_server_loads_nothing_that_computes_before_somebody_asks_for_it(home: Path) -> None:
    make_home(home, {})
    serve = "serve --until-eof --listen 127.0.0.1:0"  # ends at once: nothing is written to it
    packages = loaded(serve, home=home)[serve]
    assert packages >= {"fastapi", "uvicorn"}
    assert packages & (HEAVY - {"fastapi", "h5py"}) == set()


def test_a_supervisor_leaves_arrays_and_kernels_to_those_who_compute() -> None:
    say = (
        "import sys, sms_jobs.workers.supervisor\n"
        "print(*{'numpy', 'scipy', 'numba', 'h5py', 'cv2'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", say], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
