"""Planned motions: time-optimal along a path, and optimal control from one configuration to another."""
