"""Calling the command as a user does, on a folder that a user could have."""
