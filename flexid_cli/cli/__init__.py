"""Command line; no mathematics here."""
