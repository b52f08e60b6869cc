"""Readers of log files: one format, one file; nothing here knows of drives."""
