"""SDFormat, which is Gazebo's format: its elements, the poses of its frames, and its models."""
