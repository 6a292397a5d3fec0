"""Random motions with stops, impacts and dry friction, judged by references that share nothing with the package."""
