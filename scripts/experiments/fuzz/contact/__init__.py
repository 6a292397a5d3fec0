"""Random motions with stops, impacts and dry friction, compared with references independent of the package."""
