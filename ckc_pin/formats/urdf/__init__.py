"""Read URDFs with each of the published conventions for loops, and build the elements of a URDF."""
