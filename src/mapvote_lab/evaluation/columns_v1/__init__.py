"""Columns, version 1: nine rules lettered A to I, by which vehicles voted until surfaces were ahead of them.

No vehicle casts such ballots any more. They are kept to be compared with (docs/columns-v1.md), and only the evaluation
runs them; a server still fuses those that were cast.
"""
