"""For every test: no deadline on a property's examples. Nothing here is a timed test, and machines are busy."""

from __future__ import annotations

import hypothesis

hypothesis.settings.register_profile("mapvote", deadline=None)
hypothesis.settings.load_profile("mapvote")
