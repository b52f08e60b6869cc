"""Least squares, covariance, identifiability: from columns to parameters with intervals."""
