"""Identify flexible drive axes from motor current and encoder logs."""

__version__ = "0.1.0"
