"""Error against run time: the same work by every formulation and method here, and by the programs people use."""
