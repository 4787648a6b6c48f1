"""The databases that the server's tests run on are what they claim to be."""

from __future__ import annotations

import pytest
import sqlalchemy as sa

from postgres_cluster import PostgresCluster


@pytest.mark.contract
def test_an_empty_database_that_keeps_what_is_committed(database_url: str) -> None:
    engine = sa.create_engine(database_url)
    assert sa.inspect(engine).get_table_names() == []
    with engine.begin() as connection:
        connection.execute(sa.text("CREATE TABLE t (x INTEGER)"))
        connection.execute(sa.text("INSERT INTO t VALUES (7)"))
    engine.dispose()
    with engine.connect() as connection:
        assert connection.execute(sa.text("SELECT x FROM t")).scalar_one() == 7
    engine.dispose()


def test_postgres_is_durable_and_survives_a_power_cut(postgres_cluster: PostgresCluster, postgres_url: str) -> None:
    engine = sa.create_engine(postgres_url)
    with engine.begin() as connection:
        assert connection.execute(sa.text("SHOW fsync")).scalar_one() == "on"
        assert connection.execute(sa.text("SHOW synchronous_commit")).scalar_one() == "on"
        connection.execute(sa.text("CREATE TABLE t (x INTEGER)"))
    engine.dispose()
    postgres_cluster.stop(crash=True)
    with pytest.raises(sa.exc.OperationalError):
        engine.connect()
    postgres_cluster.start()
    assert sa.inspect(engine).get_table_names() == ["t"]
    engine.dispose()
