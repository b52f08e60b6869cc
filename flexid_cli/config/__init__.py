"""The configuration file: strict YAML 1.2, checked models, errors with file, line and column."""
