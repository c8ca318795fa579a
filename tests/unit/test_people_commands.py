"""`sms person`, `sms token` and `sms audit`, and the commands that ask for a password or a reason."""

from __future__ import annotations

import csv
import json
import os
import pty
import pwd
import re
import select
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr
from sqlalchemy import update
from support.command import SMS, answer, inside
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.catalogue.tables.audit import AuditRow
from sms_jobs.errors import NotAllowed
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.virtual_rig.campaigns import small_plate

ME = pwd.getpwuid(os.getuid()).pw_name
MINE, OTHER = "correct horse battery", "staple of the hall"


@pytest.fixture
def made(home: Path) -> Path:
    """A home in which anna is an administrator."""
    initialised(home)
    assert run(home, "person", "add", "anna", "--role", "administrator", "--no-password") == (0, "")
    return home


def run(home: Path, *words: str, given: str = "") -> tuple[int, str]:
    """Return the exit code, and what was refused."""
    done = inside(*words, "--home", str(home), given=given)
    return done.returncode, done.stderr if done.returncode else ""


def asked(home: Path, *words: str) -> Any:
    return answer(*words, "--home", str(home))


def add_me(home: Path, role: str) -> None:
    code, _ = run(home, "person", "add", ME, "--role", role, "--password-stdin", given=f"{MINE}\n")
    assert code == 0


def test_the_first_person_is_an_administrator_and_only_then_others_come(home: Path) -> None:
    initialised(home)
    code, said = run(home, "person", "add", "ben", "--role", "viewer", "--no-password")
    assert (code, "has to be an administrator" in said) == (4, True)
    assert asked(home, "person", "list") == []
    done = asked(home, "person", "add", "anna", "--role", "administrator", "--no-password")
    assert done["person"]["role"] == "administrator"
    for refused, words in (
        (2, ["person", "add", "ben", "--role", "viewer"]),
        (2, ["person", "add", "ben", "--role", "king", "--no-password"]),
        (3, ["person", "role", "max", "viewer"]),
        (4, ["person", "add", "anna", "--role", "viewer", "--no-password"]),
        (4, ["person", "off", "anna"]),
    ):
        assert run(home, *words)[0] == refused, words
    assert [p["name"] for p in asked(home, "person", "list")] == ["anna"]


def test_a_password_comes_from_standard_input(made: Path) -> None:
    for given, code in (("", 2), ("short\n", 2), (f"{MINE}\n", 0)):
        assert (
            run(made, "person", "add", "ben", "--role", "viewer", "--password-stdin", given=given)[0] == code
        )
    with bootstrap.services(made) as services:
        people.log_in(services, "ben", SecretStr(MINE))
        # An administrator needs no old password.
        assert run(made, "person", "password", "ben", "--password-stdin", given=f"{OTHER}\n")[0] == 0
        with pytest.raises(NotAllowed):
            people.log_in(services, "ben", SecretStr(MINE))
        people.log_in(services, "ben", SecretStr(OTHER))


def test_ones_own_password_needs_the_old_one(made: Path) -> None:
    add_me(made, "viewer")
    for old, code in ((OTHER, 8), ("", 8), (MINE, 0)):
        assert run(made, "person", "password", "--password-stdin", given=f"{old}\n{OTHER}\n")[0] == code


def test_a_viewer_looks_on_alone(made: Path) -> None:
    add_me(made, "viewer")
    assert asked(made, "job", "list") == []
    for words in (
        ["person", "list"],
        ["person", "add", "eve", "--role", "administrator", "--no-password"],
        ["queue", "pause", "cpu"],
        ["audit", "list"],
        ["archive", "verify"],
    ):
        code, said = run(made, *words)
        assert (code, f"{ME} is viewer and may not" in said) == (8, True), words


@pytest.mark.parametrize(
    "decided", [["certify", "no-such-session"], ["accept", "77"], ["withdraw", "77"]], ids=lambda one: one[0]
)
def test_what_calibration_is_used_asks_for_the_password(made: Path, decided: list[str]) -> None:
    words = ["calibration", *decided, "--reason", "as agreed"]
    assert run(made, *words)[0] == 3  # whoever owns the home and has no name has no password either
    add_me(made, "metrologist")
    code, said = run(made, *words)
    assert (code, "--password-stdin" in said) == (8, True)
    assert run(made, *words, "--password-stdin", given=f"{OTHER}\n")[0] == 8
    assert run(made, *words, "--password-stdin", given=f"{MINE}\n")[0] == 3


def test_a_decision_about_a_calibration_keeps_who_made_it_and_why(made: Path) -> None:
    add_me(made, "metrologist")
    with bootstrap.services(made) as services:
        calibration, _ = small_plate("plate")
        register_calibration(services.catalogue, services.archive, calibration, calibration.valid_from)
    words = ["calibration", "withdraw", "1", "--reason", "the stand was hit", "--password-stdin"]
    assert run(made, *words, given=f"{MINE}\n")[0] == 0
    (decision,) = asked(made, "calibration", "show", "1")["decisions"]
    assert (decision["by"], decision["reason"]) == (ME, "the stand was hit")
    shown = inside("calibration", "show", "1", "--home", str(made)).stdout
    assert re.search(rf"withdrawn for its rig .* by {re.escape(ME)}: the stand was hit", shown)


def test_a_token_is_shown_once_and_lets_in_until_it_is_revoked(made: Path) -> None:
    code, said = run(made, "token", "create", "nightly")
    assert (code, "has no name here" in said) == (3, True)
    add_me(made, "analyst")
    printed = inside("token", "create", "nightly", "--days", "30", "--home", str(made)).stdout.strip()
    assert re.fullmatch(r"sms_[A-Za-z0-9_-]{43}", printed)
    with bootstrap.services(made) as services:
        actor = people.actor_of(services, printed, "here")
        assert (actor.name, actor.role and actor.role.value, actor.via) == (ME, "analyst", "token")
        (token,) = asked(made, "token", "list")
        assert (token["sort"], token["label"], token["used_at"] is None) == ("token", "nightly", False)
        assert printed not in json.dumps(token)
        assert run(made, "token", "revoke", token["id"]) == (0, "")
        with pytest.raises(NotAllowed):
            people.actor_of(services, printed, "here")
    assert run(made, "token", "revoke", token["id"])[0] == 3


def test_the_audit_is_listed_and_written(made: Path, tmp_path: Path) -> None:
    run(made, "person", "add", "ben", "--role", "viewer", "--no-password")
    run(made, "person", "off", "ben", "--reason", "=left in June")
    run(made, "queue", "pause", "cpu")
    links = asked(made, "audit", "list")
    assert [link["action"] for link in links] == [
        "queues.pause",
        "people.set_active",
        "people.add",
        "people.add",
    ]
    assert links[1]["reason"] == "=left in June"
    assert links[1]["arguments"] == {"name": "ben"}
    assert asked(made, "audit", "list", "--action", "people", "--limit", "1") == [links[1]]
    assert asked(made, "audit", "list", "--action", "people.add", "--who", ME) == links[2:]
    assert asked(made, "audit", "list", "--since", links[0]["at"]) == [links[0]]
    assert asked(made, "audit", "list", "--who", "anna") == []
    newest = asked(made, "audit", "list", "--limit", "2")
    assert newest == links[:2]
    assert asked(made, "audit", "list", "--limit", "2", "--after", str(newest[-1]["number"])) == links[2:]
    assert asked(made, "audit", "list", "--after", "1") == []
    lines, table = tmp_path / "audit.jsonl", tmp_path / "audit.csv"
    assert asked(made, "audit", "export", str(lines))["links"] == 4
    assert [json.loads(line) for line in lines.read_text().splitlines()] == links[::-1]
    asked(made, "audit", "export", str(table))
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["digest"] for row in rows] == [link["digest"] for link in links[::-1]]
    assert rows[2]["reason"] == "'=left in June"  # no spreadsheet computes it
    assert run(made, "audit", "export", str(table))[0] == 4
    assert run(made, "audit", "export", str(tmp_path / "audit.txt"))[0] == 2


def test_what_was_changed_behind_the_audits_back_is_found(made: Path) -> None:
    kept = inside("audit", "head", "--home", str(made)).stdout.strip()
    assert run(made, "audit", "verify", "--head", kept) == (0, "")
    number, _, digest = kept.partition(":")
    assert run(made, "audit", "verify", "--head", f"{int(number) + 1}:{digest}")[0] == 6
    assert run(made, "audit", "verify", "--head", digest)[0] == 2
    assert run(made, "archive", "verify") == (0, "")
    with bootstrap.services(made) as services, services.catalogue.writing() as session:
        session.execute(update(AuditRow).values(who="eve"))
    done = inside("audit", "verify", "--home", str(made))
    assert (done.returncode, "audit 1 (people.add by eve) is not as it was written" in done.stdout) == (
        6,
        True,
    )
    done = inside("archive", "verify", "--home", str(made))
    assert (done.returncode, "audit 1 (people.add by eve)" in done.stdout) == (6, True)


def test_a_catalogue_that_is_made_anew_begins_a_new_chain_and_says_so(made: Path) -> None:
    (made / "catalogue.sqlite").unlink()
    done = inside("archive", "reindex", "--home", str(made))
    assert (done.returncode, "its audit begins a new chain" in done.stderr) == (0, True)
    (first, *_) = asked(made, "audit", "list")[::-1]
    assert (first["number"], first["action"]) == (1, "audit.begin")
    assert "filled anew" in first["reason"]


def test_on_a_terminal_passwords_and_reasons_are_asked_for_and_passwords_not_shown(made: Path) -> None:
    shown, code = typed(
        [*SMS, "person", "add", "ben", "--role", "viewer", "--home", str(made)],
        [
            ("New password of ben: ", MINE),
            ("again: ", "another one altogether"),
            ("New password of ben: ", MINE),
            ("again: ", MINE),
        ],
    )
    assert (code, MINE in shown, "ben is viewer" in shown) == (0, False, True)
    _, code = typed([*SMS, "person", "off", "ben", "--home", str(made)], [("(Enter for none): ", "left")])
    assert code == 0
    (last,) = asked(made, "audit", "list", "--limit", "1")
    assert (last["action"], last["reason"]) == ("people.set_active", "left")
    with bootstrap.services(made) as services, pytest.raises(NotAllowed):
        people.log_in(services, "ben", SecretStr(MINE))


def typed(command: list[str], answers: list[tuple[str, str]]) -> tuple[str, int]:
    """Run a command on a terminal, answer its questions, and return all that was shown and the exit code.

    A question ends with the space behind it: what is typed before that is thrown away.
    """
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, command)
    shown, seen, waiting = b"", 0, list(answers)
    while True:
        if not select.select([terminal], [], [], 60.0)[0]:
            os.kill(child, signal.SIGKILL)
        try:
            part = os.read(terminal, 4096)
        except OSError:  # its other end was closed
            break
        shown += part
        if waiting and waiting[0][0].encode() in shown[seen:]:
            seen = len(shown)
            os.write(terminal, waiting.pop(0)[1].encode() + b"\n")
    _, status = os.waitpid(child, 0)
    os.close(terminal)
    assert waiting == [], shown
    return shown.decode(), os.waitstatus_to_exitcode(status)
