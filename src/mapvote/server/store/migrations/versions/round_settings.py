"""A round votes by one set of settings: say which, for a round under way. Those of its last ballot.

Rounds of the first schema only said method and stage; new ballots would not fit them.
"""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """``maps.method``: "columns, two-stage" becomes "columns, two-stage, settings ab12..."."""
    connection = op.get_bind()
    method = connection.execute(sa.text("SELECT method FROM maps")).scalar_one_or_none()
    newest = sa.text("SELECT settings_hash FROM ballots WHERE gone_seq IS NULL ORDER BY seq DESC LIMIT 1")
    settings = connection.execute(newest).scalar_one_or_none()
    if method is not None and settings is not None and ", settings " not in method:
        named = f"{method}, settings {settings[:32]}"
        connection.execute(sa.text("UPDATE maps SET method = :named"), {"named": named})
