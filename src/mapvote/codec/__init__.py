"""Arrays, tiles and ballots as bytes."""
