"""The report: one document, one renderer a file; nothing is computed here."""
