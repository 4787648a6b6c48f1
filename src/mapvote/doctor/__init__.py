"""What is wrong with a drive, a map, a ballot or a store, and how to mend it: measured where it can be, not guessed.

:mod:`mapvote.doctor.diagnosis` lists the checks. docs/decisions/doctor.md gives the reasons.
"""
