"""One scan becomes evidence (paper II, III): localise, remove moving objects, see, classify."""
