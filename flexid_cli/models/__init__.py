"""Identification models: one model, one file; they see arrays, never files."""
