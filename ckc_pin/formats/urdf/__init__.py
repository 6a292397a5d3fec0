"""URDFs with loops, in each of the ways that others write them, and the elements of the URDFs that we write."""
