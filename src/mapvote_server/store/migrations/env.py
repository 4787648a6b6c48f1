"""Run by alembic: the revisions beside this file, on a given connection and within its transaction."""

from alembic import context

context.configure(connection=context.config.attributes["connection"])
with context.begin_transaction():
    context.run_migrations()
