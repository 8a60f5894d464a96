"""The comparison: trials, tables, curves, intervals, tuning."""
