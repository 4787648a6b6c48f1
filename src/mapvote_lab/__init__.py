"""The laboratory: simulated streets with their truth, and the evaluation of mapvote on them (extra ``lab``)."""
