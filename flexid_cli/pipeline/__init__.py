"""Zero-phase filters, derivatives, parallel decimation and their tuning."""
