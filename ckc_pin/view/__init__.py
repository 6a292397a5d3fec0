"""Figures and playback of saved runs. matplotlib, tornado and meshcat's files are loaded by what needs them."""
