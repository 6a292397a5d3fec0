"""Figures, playback and notebook display of results. matplotlib, tornado and meshcat are imported only when needed."""
