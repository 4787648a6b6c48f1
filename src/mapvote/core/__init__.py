"""Nouns and array mathematics: no files, no network, no terminal."""
