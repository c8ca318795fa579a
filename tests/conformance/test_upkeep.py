"""The database knows how its tables are filled, in homes of people as in the tests of queries."""

from __future__ import annotations

from contextlib import closing

from sqlalchemy import text
from support.command import inside
from support.deployments import Deployment
from support.homes import make_home

from sms_jobs.bench.large import many_files
from sms_jobs.catalogue import upkeep
from sms_jobs.catalogue.database import Catalogue


def looked_at(catalogue: Catalogue) -> set[str]:
    """Return the tables that the database has looked at."""
    with catalogue.reading() as session:
        if catalogue.dialect == "sqlite":
            if not session.scalar(text("SELECT count(*) FROM sqlite_master WHERE name = 'sqlite_stat1'")):
                return set()
            return set(session.scalars(text("SELECT tbl FROM sqlite_stat1")))
        return set(session.scalars(text("SELECT relname FROM pg_class WHERE reltuples > 0")))


def test_what_has_been_filled_is_looked_at(catalogue: Catalogue) -> None:
    assert looked_at(catalogue) & {"file", "statistic", "job"} == set()
    many_files.fill(catalogue, 640)
    assert {"file", "statistic", "job"} <= looked_at(catalogue)
    upkeep.analyse(catalogue)  # again, while it is in use
    assert {"file", "statistic", "job"} <= looked_at(catalogue)


def test_a_supervisor_lets_the_database_look(deployment: Deployment) -> None:
    make_home(deployment.home, deployment.environment)
    ended = inside("up", "--until-idle", "--home", str(deployment.home), environment=deployment.environment)
    assert ended.returncode == 0, ended.stderr
    with closing(deployment.catalogue()) as catalogue:
        assert "campaign" in looked_at(catalogue)
