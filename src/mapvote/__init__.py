"""mapvote keeps 3D point-cloud maps true: vehicles vote on what has changed."""
