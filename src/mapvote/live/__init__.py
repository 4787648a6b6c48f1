"""A vehicle that votes while it drives: ROS 2 topics are read from DDS, and no ROS installation is needed."""
