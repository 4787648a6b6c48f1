"""What a server does before anybody asks."""

from __future__ import annotations

import gc

from mapvote.codec import ballot
from mapvote.server.http.warming import settle


def test_what_a_server_has_loaded_is_ready_for_the_first_ballot_and_never_looked_at_again_by_the_collector() -> None:
    before = gc.get_freeze_count()
    try:
        settle()
        assert gc.get_freeze_count() > before + 10_000
        assert ballot._all_states.signatures
    finally:
        gc.unfreeze()
