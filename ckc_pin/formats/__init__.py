"""Other people's files: MJCF, URDF with loops, robot.yaml; and what is written for other programs."""
