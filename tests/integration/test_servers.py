"""The servers that ops/test.sh starts are what the service needs."""

from __future__ import annotations

import pytest
import redis
import sqlalchemy


@pytest.mark.postgresql
def test_a_fresh_database_is_empty_and_writable(fresh_postgresql_url: str) -> None:
    engine = sqlalchemy.create_engine(fresh_postgresql_url, poolclass=sqlalchemy.pool.NullPool)
    assert sqlalchemy.inspect(engine).get_table_names() == []
    with engine.begin() as connection:
        connection.execute(sqlalchemy.text("CREATE TABLE reading (load_n float8)"))
    assert sqlalchemy.inspect(engine).get_table_names() == ["reading"]


@pytest.mark.redis
def test_redis_keeps_every_message(redis_url: str) -> None:
    # Without both of these a broker may lose messages, and a test of recovery would test something else.
    with redis.Redis.from_url(redis_url) as client:
        assert client.dbsize() == 0
        assert client.config_get("appendonly") == {"appendonly": "yes"}
        assert client.config_get("maxmemory-policy") == {"maxmemory-policy": "noeviction"}
        client.set("left behind", "1")  # the next test's database is empty all the same


@pytest.mark.redis
def test_every_test_finds_redis_empty(redis_url: str) -> None:
    with redis.Redis.from_url(redis_url) as client:
        assert client.dbsize() == 0
