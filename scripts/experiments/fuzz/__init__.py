"""Random motions, compared with an integration that is independent of the package."""
