"""What is wrong with a drive, a map, a ballot or a store, and how to mend it: measured where it can be, not guessed.

Cheap looks at every file come first (:mod:`mapvote.doctor.scans`, :mod:`mapvote.doctor.prior`), then scans are
registered to each other (:mod:`mapvote.doctor.motion`) and the motion found is held against the prior under every
reading of it (:mod:`mapvote.doctor.frames`). docs/decisions/doctor.md says why.
"""
