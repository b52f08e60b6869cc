"""Signals and recordings: signal paths, units, sides, and the time base."""
